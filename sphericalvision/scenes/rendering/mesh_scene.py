# SPDX-License-Identifier: Apache-2.0
"""Textured meshes from files as scenes: what rays hit first, and the colour that the mesh has there."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.core import ArgumentError, FileFormatError, check_choice, check_file
from sphericalvision.scenes.rendering.scene import sky_light

if TYPE_CHECKING:
    import trimesh

Array = npt.NDArray[Any]

#: Rows are x, y, z of the world (y down) in the axes of files whose up is y (glTF) or z (many scans).
AXES = {
    "y": ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    "z": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
}
SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")
#: What fits into a few gigabytes: triangles of all pieces, and pixels of all textures.
MOST_TRIANGLES, MOST_PIXELS = 2**24, 2**28


class MeshScene:
    """Triangles with colours, in the world of the rig (y down, metres), to be rendered as scenes are.

    Depth along a ray is that of the first triangle, seen from either side. Colours are those of the mesh, as scans have
    them: light and shadow are already in them. They come from a texture, from colours of vertices or faces, or from the
    material, in this order.

    Args:
        mesh: a ``trimesh.Trimesh`` or ``trimesh.Scene``.
        up: axis that points up in the mesh, ``"y"`` (glTF) or ``"z"``; the other axes follow, nothing is mirrored.
        scale: metres in one unit of the mesh.
        center: ``(3,)`` point of the mesh, in its own axes and units, where the world's origin shall be.

    Raises:
        ArgumentError: an unknown axis, a scale that is not positive, no triangles, more than 2**24 of them in all
            pieces, or textures of more than 2**28 pixels.
        ImportError: embreex, which intersects rays with triangles, is missing; it comes with
            ``pip install embreex``.

    Examples:
        >>> import trimesh
        >>> from sphericalvision.scenes import ray_depth
        >>> room = MeshScene(trimesh.creation.box((4.0, 3.0, 6.0)))
        >>> ray_depth(room, torch.zeros(3), torch.tensor([[0.0, 1.0, 0.0]]))
        tensor([1.5000])
    """

    def __init__(
        self,
        mesh: trimesh.Trimesh | trimesh.Scene,
        up: str = "y",
        scale: float = 1.0,
        center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        check_choice("up", up, tuple(AXES))
        if not scale > 0:
            raise ArgumentError(f"scale: expected metres in a unit of the mesh, above 0, got {scale}")
        parts, places = _placed(mesh)
        _check_size(parts, places)
        rotation = np.array(AXES[up])
        vertices = [parts[number].vertices @ pose[:3, :3].T + pose[:3, 3] for number, pose in places]
        self.vertices = scale * (np.concatenate(vertices) - np.array(center)) @ rotation.T
        starts = np.cumsum([0, *map(len, vertices)])
        faces = [parts[number].faces + start for (number, _), start in zip(places, starts, strict=False)]
        self.faces = np.concatenate(faces)
        numbers = [number for number, _ in places]
        self.part_of_face = torch.from_numpy(np.repeat(numbers, [len(each) for each in faces]))
        appearances = [_look(part) for part in parts]
        self.textures = [texture for texture, _ in appearances]
        self.corner_values = torch.cat([appearances[number][1] for number in numbers])
        self.exposure = torch.tensor(1.0)
        self.background = torch.zeros(2, 3)
        _ = self._caster  # says at once if it cannot be made

    @property
    def device(self) -> torch.device:
        """Where rays are cast: the CPU."""
        return torch.device("cpu")

    @cached_property
    def _caster(self) -> Any:
        import trimesh

        try:
            from trimesh.ray.ray_pyembree import RayMeshIntersector
        except BaseException as error:
            raise ImportError(
                "MeshScene: embreex intersects rays with triangles and is not installed; pip install embreex"
            ) from error
        return RayMeshIntersector(trimesh.Trimesh(self.vertices, self.faces, process=False))

    def trace(
        self, origin: Float[Tensor, " 3"], directions: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
        """First triangle along each ray.

        Embree finds the triangle in float32; the distance to its plane is computed in float64.

        Args:
            origin: ``(3,)`` metres.
            directions: ``(n, 3)`` unit directions.

        Returns:
            Metres ``(n,)``, inf where nothing is hit, and faces ``(n,)``, -1 there.
        """
        rays = directions.detach().cpu().double().numpy()
        start = origin.detach().cpu().double().numpy()
        face = self._caster.intersects_first(np.broadcast_to(start, rays.shape), rays)
        hit = face >= 0
        a, b, c = (self.vertices[self.faces[face[hit], k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            along = ((a - start) * normal).sum(1) / (rays[hit] * normal).sum(1)
        distance = np.full(len(rays), np.inf)
        distance[hit] = np.where(np.isfinite(along) & (along > 0), along, np.inf)
        return torch.from_numpy(distance).float(), torch.from_numpy(np.asarray(face)).long()

    def light(self, origin: Float[Tensor, " 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear colours ``(n, 3)`` along rays ``(n, 3)`` from a point; the background where nothing is hit."""
        distance, face = self.trace(origin, directions)
        color = sky_light(self.background, torch.zeros(0, 5), directions.T).T.contiguous()
        hit = (face >= 0) & distance.isfinite()
        points = origin.double() + distance[hit, None].double() * directions[hit].double()
        values = self._interpolated(points, face[hit])
        piece = self.part_of_face[face[hit]]
        colors = values.clone()
        for number, texture in enumerate(self.textures):
            if texture is not None and bool((mine := piece == number).any()):
                colors[mine] = _sampled(texture, values[mine, :2])
        color[hit] = colors
        return color

    def _interpolated(self, points: Tensor, face: Tensor) -> Tensor:
        """Values of the corners ``(n, 3)`` by barycentric coordinates."""
        a, b, c = torch.from_numpy(self.vertices[self.faces[face.numpy()]]).unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        area = normal.square().sum(-1).clamp(min=1e-30)
        v = (torch.linalg.cross(points - a, c - a) * normal).sum(-1) / area
        w = (torch.linalg.cross(b - a, points - a) * normal).sum(-1) / area
        weights = torch.stack([1 - v - w, v, w], -1).clamp(0, 1)
        weights = (weights / weights.sum(-1, keepdim=True)).float()
        return (weights[:, :, None] * self.corner_values[face]).sum(1)


def read_mesh_scene(
    path: str | Path,
    up: str = "y",
    scale: float = 1.0,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> MeshScene:
    """Read a textured mesh as a scene: ``.glb``, ``.gltf``, ``.obj``, ``.ply``, ``.stl`` or ``.off``.

    Args:
        path: the file; textures that it names lie in its folder, or below; a warning says which ones do not.
        up: axis that points up in the file, ``"y"`` or ``"z"``.
        scale: metres in one unit of the file.
        center: point of the file's own coordinates where the rig's world has its origin.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: another suffix, or the file cannot be read, has no triangles, or more of them or of pixels than
            a ``MeshScene`` takes.
        ImportError: embreex is missing (``pip install embreex``).

    Examples:
        >>> import trimesh
        >>> from sphericalvision.scenes import ray_depth
        >>> _ = trimesh.creation.box((6.0, 2.5, 5.0)).export("room.stl")
        >>> scene = read_mesh_scene("room.stl")
        >>> ray_depth(scene, torch.zeros(3), torch.eye(3))
        tensor([3.0000, 1.2500, 2.5000])
    """
    # trimesh takes half a second to import
    from sphericalvision.scenes.rendering.mesh_reading import load_mesh

    path = check_file(path, "a mesh")
    if path.suffix.lower() not in SUFFIXES:
        raise FileFormatError(
            f"{path}: expected a mesh ({', '.join(SUFFIXES)}), got the suffix {path.suffix!r}"
        )
    loaded = load_mesh(path)
    try:
        _check_size(*_placed(loaded))
    except ArgumentError as error:
        raise FileFormatError(f"{path}: {error}") from None
    try:
        return MeshScene(loaded, up, scale, center)
    except (ArgumentError, ImportError):
        raise
    except Exception as error:  # vertices of two coordinates, corners that do not exist
        raise FileFormatError(
            f"{path}: its triangles or textures make no sense ({type(error).__name__}: {error})"
        ) from error


def _placed(mesh: trimesh.Trimesh | trimesh.Scene) -> tuple[list[trimesh.Trimesh], list[tuple[int, Array]]]:
    """The meshes of a scene, and the number and pose of each piece of it: one mesh may be in many places."""
    import trimesh

    if isinstance(mesh, trimesh.Trimesh):
        return [mesh], [(0, np.eye(4))]
    pieces = {name: part for name, part in mesh.geometry.items() if isinstance(part, trimesh.Trimesh)}
    numbers = {name: number for number, name in enumerate(pieces)}
    poses = [mesh.graph[node] for node in mesh.graph.nodes_geometry]
    return list(pieces.values()), [(numbers[name], pose) for pose, name in poses if name in numbers]


def _check_size(parts: list[trimesh.Trimesh], places: list[tuple[int, Array]]) -> None:
    """Raise ``ArgumentError`` unless there are triangles, neither too many of them nor of pixels, and whose colours."""
    triangles = sum(len(parts[number].faces) for number, _ in places)
    if not 0 < triangles <= MOST_TRIANGLES:
        raise ArgumentError(
            f"mesh: expected triangles, at most {MOST_TRIANGLES} in all pieces, found {triangles or 'none'}"
        )
    for part in parts:
        visual: Any = part.visual
        if visual.kind == "face" and len(visual.face_colors) != len(part.faces):
            raise ArgumentError(
                f"mesh: its {len(visual.face_colors)} colours are of polygons, which are {len(part.faces)} "
                "triangles here; expected a colour for each triangle or vertex"
            )
    images = {id(image): image for image in (_image(part.visual) for part in parts) if image is not None}
    pixels = sum(image.width * image.height for image in images.values())
    if pixels > MOST_PIXELS:
        raise ArgumentError(
            f"mesh: expected textures of at most {MOST_PIXELS} pixels together, found {pixels}"
        )


def _look(part: trimesh.Trimesh) -> tuple[Tensor | None, Tensor]:
    """The texture of a mesh, if any, bytes ``(h, w, 3)``, and values of the corners of its faces ``(f, 3, 3)``.

    Values are texture coordinates (and 0), or linear colours where there is no texture.
    """
    visual: Any = part.visual
    image = _image(visual)
    if image is not None and getattr(visual, "uv", None) is not None:
        uv = np.asarray(visual.uv, dtype=np.float32)[part.faces]
        corner = torch.zeros(len(part.faces), 3, 3)
        corner[..., :2] = torch.from_numpy(uv)
        return torch.from_numpy(np.array(image.convert("RGB"))), corner
    if visual.kind == "vertex":
        return None, _linear(torch.from_numpy(visual.vertex_colors[:, :3][part.faces]))
    if visual.kind == "face":
        colors = _linear(torch.from_numpy(visual.face_colors[:, :3].copy()))
        return None, colors[:, None].expand(-1, 3, -1).clone()
    material: Any = getattr(visual, "material", None)
    if hasattr(material, "baseColorFactor"):
        return None, _shade(material.baseColorFactor, visual.vertex_attributes.get("color"), part.faces)
    color = getattr(material, "main_color", (180, 180, 180, 255))
    plain = _linear(torch.tensor(np.array(color, dtype=np.uint8)[:3]))
    return None, plain.expand(len(part.faces), 3, 3).clone()


def _shade(factor: Array | None, colors: Array | None, faces: Array) -> Tensor:
    """Linear colours of corners ``(f, 3, 3)``: a material's factor times colours of vertices, as glTF has it."""
    shade = np.ones((len(faces), 3, 3), np.float32)
    for levels in (factor, None if colors is None else colors[faces]):
        if levels is not None:
            shade *= levels[..., :3] / (255 if levels.dtype.kind == "u" else 1)
    return torch.from_numpy(shade)


def _image(visual: Any) -> Any:
    """The picture of colours of a material, of any of the kinds that trimesh has."""
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None)
    return getattr(material, "image", None) if image is None else image


def _sampled(texture: Tensor, uv: Tensor) -> Tensor:
    """Linear colours ``(n, 3)`` at ``(n, 2)``, whose v points up; bilinear, repeated beyond the unit square."""
    height, width = texture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left, top = x.floor(), y.floor()
    x, y = (x - left)[:, None], (y - top)[:, None]
    columns = [(left + k).long() % width for k in (0, 1)]
    rows = [(top + k).long() % height for k in (0, 1)]
    upper, lower = (_linear(texture[r, columns[0]]).lerp(_linear(texture[r, columns[1]]), x) for r in rows)
    return upper.lerp(lower, y)


def _linear(levels: Tensor) -> Tensor:
    """Bytes of a picture as linear light, by the display curve of the renderer."""
    return (levels.float() / 255) ** 2.2
