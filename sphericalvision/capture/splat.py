# SPDX-License-Identifier: Apache-2.0
"""Frames as data sets for Gaussian splatting and NeRF: images, poses, points, depth, normals and masks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import (
    Camera,
    CameraRig,
    EquirectangularCamera,
    PinholeCamera,
    Remap,
    convert,
    points_from_depth,
    z_from_depth,
)
from sphericalvision.cameras.calibration.colmap import write_colmap_model
from sphericalvision.cameras.calibration.colmap_records import PointRecords
from sphericalvision.cameras.calibration.nerfstudio import nerfstudio_content
from sphericalvision.cameras.calibration.text_files import write_json
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.capture.pinhole_twins import pinhole_twins
from sphericalvision.capture.points import SurfacePoints, grid_faces, hangs_between, surface_normals
from sphericalvision.capture.result import Depth
from sphericalvision.core import ArgumentError
from sphericalvision.io.files import part_of_name
from sphericalvision.io.images import read_pages, write_image, write_mask, write_pages
from sphericalvision.kernels import full_precision
from sphericalvision.viz.pointcloud import save_point_cloud

NATIVE, PINHOLE = "native", "pinhole"
"""Folders of the two data sets: with the lenses themselves, and with their pinhole twins."""
MILLIMETRES = 1000
"""Steps of depth in a metre, in PNGs of 16 bits, where 0 is unknown."""
AGREES = 0.05
"""Share of its distance by which a point may be before or behind the depth of a pixel that shows it."""
FINENESS = 2.0
"""Pixels of maps between two directions of the network's grid; finer images interpolate between them."""
ALL_USABLE = 0.99
"""Share of a pixel of a twin that has to be usable."""
VISIBLE_ERROR = 0.5
"""Pixels between a lens and the model that stands for it, from which on it is said."""


class _View(NamedTuple):
    """A camera of a data set, where one of the rig's cameras stands."""

    kind: str
    """``NATIVE`` or ``PINHOLE``."""
    name: str
    camera: Camera
    pose: Tensor
    """``(4, 4)`` from this camera to the rig's."""
    seen: Tensor
    """``(h, w)`` bool: where its image shows something usable."""
    images: Remap | None
    """From images of the rig's camera; None where they are the same."""
    maps: Remap
    """From maps in the coarse pixels of the rig's camera."""


class SplatScene:
    """Writes frames into a folder that trainers of Gaussian splatting and NeRF read.

    It has up to two data sets: ``native`` with the lenses themselves, unless all are pinholes, and ``pinhole`` with
    their twins. In each, ``images``, ``masks`` (white: usable), ``depth`` and ``normals`` hold
    ``<camera>/<frame>.png``, ``sparse/0`` is a model of COLMAP in text and binary with points and their tracks, and
    ``transforms.json`` with ``points3D.ply`` is nerfstudio's. Lenses that nerfstudio has no model for become
    ``OPENCV_FISHEYE``.

    Depth has 16 bits and is in millimetres: along the axis (z) of pinholes, along the ray for other lenses, 0 where no
    two cameras look, or beyond 65 m. Normals are towards the camera, in its frame with x right, y down and z forward,
    from -1 to 1 in 8 bits; black where there is no depth.

    Args:
        folder: of both data sets.
        min_confidence: less confident depth is not written.

    Attributes:
        folder: of both; another one may be set when one is closed, for other frames of the same cameras.
        notes: what a user should know of lenses that another model stands for.
    """

    def __init__(self, folder: Path, min_confidence: float = 0.0) -> None:
        self.folder, self.min_confidence = folder, min_confidence
        self.notes: list[str] = []
        self._origin = torch.zeros(3, dtype=torch.float64)
        self._views: dict[str, list[_View]] = {}
        self._coarse: dict[str, Camera] = {}
        self._frames: dict[str, dict[str, CameraRig]] = {}
        self._behind: dict[str, tuple[list[str], Depth]] = {}

    @torch.inference_mode()
    @full_precision
    def add(self, frame: str, depth: Depth) -> None:
        """Write images and maps of a frame; of a window those of the moment that it is called by.

        No window is called by an end of a walk: the first one brings the moments before its own, and the last one those
        behind it when the models are written.
        """
        moments: dict[str, list[str]] = {}
        for name in depth.rig.names:
            moments.setdefault(name.rsplit("@", 1)[-1], []).append(name)
        if frame not in moments:  # the rig is no window
            moments = {frame: depth.rig.names}
        order = list(moments)
        position = order.index(frame)
        if not self._frames:
            self._origin = depth.rig.to("cpu").origin
            for moment in order[:position]:
                self._add_moment(moment, moments[moment], depth)
        self._add_moment(frame, moments[frame], depth)
        self._behind = {moment: (moments[moment], depth) for moment in order[position + 1 :]}

    def _add_moment(self, frame: str, moment: list[str], depth: Depth) -> None:
        """Write images and maps of the cameras of one moment of a rig."""
        rig = depth.rig.to("cpu")
        names = ["camera"] if moment == [frame] else [name.rsplit("@", 1)[0] for name in moment]
        own = rig.subset(moment)
        cameras_by_name = dict(zip(map(part_of_name, names), own.cameras.values(), strict=True))
        own = CameraRig(cameras_by_name, own.world_from_camera)
        masks = {name: rig.masks.get(view) for name, view in zip(own.names, moment, strict=True)}
        if not self._views:
            self._begin(own, masks, math.sqrt(4 * math.pi / depth.index.numel()))
        frame = part_of_name(frame or "0")
        surface = self._surface(depth)
        cameras: dict[str, dict[str, Camera]] = {}
        poses: dict[str, list[Tensor]] = {}
        for name, view_name, pose in zip(own.names, moment, own.world_from_camera, strict=True):
            maps, valid = _seen_from(depth, self._coarse[name], pose, surface)
            image = depth.images[view_name].cpu()
            for view in self._views[name]:
                world_from_view = pose.double() @ view.pose
                world_from_view[:3, 3] += rig.origin - self._origin
                poses.setdefault(view.kind, []).append(world_from_view)
                cameras.setdefault(view.kind, {})[view.name] = view.camera
                self._write(view, frame, image, maps, valid)
        self._frames[frame] = {kind: CameraRig(cameras[kind], torch.stack(poses[kind])) for kind in cameras}

    @torch.inference_mode()
    @full_precision
    def close(self, cloud: SurfacePoints) -> list[Path]:
        """Write the models, with these points of the world that poses are in; returns their files."""
        for moment, (names, depth) in self._behind.items():
            self._add_moment(moment, names, depth)
        points = cloud.points.cpu().double() - self._origin
        colors = (255 * cloud.colors.cpu().clamp(0, 1)).round().byte()
        written = []
        for kind in next(iter(self._frames.values())):
            folder = self.folder / kind
            rigs = {frame: rigs[kind] for frame, rigs in self._frames.items()}
            sightings = {
                f"{name}/{frame}": _sighted(points, camera, pose, folder / f"depth/{name}/{frame}.png")
                for frame, rig in rigs.items()
                for (name, camera), pose in zip(rig.cameras.items(), rig.camera_from_world, strict=True)
            }
            records = PointRecords(points.numpy(), colors.numpy())
            write_colmap_model(rigs, folder / "sparse/0", records, sightings)
            everything = {
                f"{name}/{frame}": camera
                for frame, rig in rigs.items()
                for name, camera in rig.cameras.items()
            }
            poses = torch.cat([rig.world_from_camera for rig in rigs.values()])
            content = nerfstudio_content(CameraRig(everything, poses))
            for entry, name in zip(content["frames"], everything, strict=True):
                entry["mask_path"] = f"masks/{name}.png"
                entry["depth_file_path"] = f"depth/{name}.png"
                entry["normal_file_path"] = f"normals/{name}.png"
            content["depth_unit_scale_factor"] = 1 / MILLIMETRES
            written += [folder / "sparse/0/points3D.bin", folder / "transforms.json"]
            if len(points):
                content["ply_file_path"] = "points3D.ply"
                written.append(
                    save_point_cloud(folder / "points3D.ply", points.float(), colors, cloud.normals)
                )
            write_json(folder / "transforms.json", content)
        self._frames, self._behind = {}, {}
        return written

    def _begin(self, rig: CameraRig, masks: Mapping[str, Tensor | None], spacing: float) -> None:
        """Choose the cameras of the data sets; ``spacing`` is that of the network's directions, radians."""
        lenses = self._native(rig)
        for name, camera in rig.cameras.items():
            scale = min(1.0, FINENESS / (spacing * pixels_a_radian(camera)))
            coarse = camera.resized([max(1, round(scale * side)) for side in camera.image_size])
            self._coarse[name] = coarse
            mask = masks[name]
            usable = torch.ones(camera.image_size, dtype=torch.bool) if mask is None else mask
            views = []
            if lens := lenses.get(name):
                seen = usable & lens.unproject(lens.pixel_grid())[1]
                same = torch.eye(4).double()
                views.append(_View(NATIVE, name, lens, same, seen, None, Remap(coarse, lens)))
            for twin in pinhole_twins(camera):
                seen = twin.remap(usable[None].float())[0] > ALL_USABLE
                maps = Remap(coarse, twin.camera, twin.pose[:3, :3].mT)
                key = f"{name}_{twin.name}" if twin.name else name
                views.append(_View(PINHOLE, key, twin.camera, twin.pose, seen, twin.remap, maps))
            self._views[name] = views

    @torch.inference_mode(False)  # which a fit cannot do without gradients
    def _native(self, rig: CameraRig) -> dict[str, Camera]:
        """Cameras in one model that trainers know; none where all are pinholes, or where there is none."""
        if all(isinstance(camera, PinholeCamera) for camera in rig.cameras.values()):
            return {}
        try:
            nerfstudio_content(rig)
            return rig.cameras
        except ArgumentError:
            pass
        try:
            fits = {
                name: convert(camera.to(torch.float64), "kannala_brandt")
                for name, camera in rig.cameras.items()
            }
        except ArgumentError as error:
            self.notes.append(f"splat: {NATIVE} is left out, {PINHOLE} has all cameras ({error})")
            return {}
        name, worst = max(fits.items(), key=lambda fit: fit[1].max_error)
        if worst.max_error > VISIBLE_ERROR:
            self.notes.append(
                f"splat: OPENCV_FISHEYE, which stands for {name} in {NATIVE}, is off by up to {worst.max_error:.1f} "
                f"pixels; {PINHOLE} is exact"
            )
        return {name: fit.camera.to(rig.world_from_camera.dtype) for name, fit in fits.items()}

    def _surface(self, depth: Depth) -> Tensor:
        """Normals in the world, and 1 where depth is sure and does not hang between near and far ``(4, *grid)``."""
        grid, inverse_depth = depth.network.grid, depth.inverse_depth.flatten().float()
        rays, faces = grid.directions.reshape(-1, 3).float(), grid_faces(grid)
        normals = surface_normals(rays / inverse_depth[:, None], faces)
        sure = (depth.confidence.flatten() >= self.min_confidence) & (inverse_depth * depth.max_depth >= 1)
        sure = sure & ~hangs_between(inverse_depth, rays, faces)
        return torch.cat((normals.mT, sure[None].float())).unflatten(1, grid.shape)

    def _write(self, view: _View, frame: str, image: Tensor, maps: Tensor, valid: Tensor) -> None:
        """Write image, mask and maps of a view, from those of the rig's camera."""
        name, folder = f"{view.name}/{frame}.png", self.folder / view.kind
        write_image(folder / "images" / name, image if view.images is None else view.images(image))
        write_mask(folder / "masks" / name, view.seen)
        visible = view.maps(maps, valid)
        valid = view.seen & (view.maps(valid[None].float())[0] > 0.5) & (visible[0] > 0)
        depth = 1 / visible[0].where(valid, 1.0)
        if isinstance(view.camera, PinholeCamera):
            depth = z_from_depth(depth, view.camera)[0]
        steps = (MILLIMETRES * depth).round()
        valid = valid & (steps < 2**16)
        write_pages(folder / "depth" / name, [steps.where(valid, 0).numpy().astype(np.uint16)])
        normals = F.normalize((visible[1:].movedim(0, -1) @ view.pose[:3, :3].float()), dim=-1)
        shades = (255 * (normals + 1) / 2).round() * valid[..., None]
        write_image(folder / "normals" / name, shades.byte().numpy())


def _seen_from(depth: Depth, camera: Camera, pose: Tensor, surface: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse range and normals in the camera's frame ``(4, h, w)``, and where they count ``(h, w)``."""
    measured = depth.camera(camera, pose).measured.cpu()
    points, valid = points_from_depth(measured, camera)
    rotation = pose[:3, :3].float()
    directions = F.normalize(points @ rotation.mT + (pose[:3, 3] - depth.rig.center.cpu()), dim=-1)
    values, _ = depth.network.index_at(surface, directions.reshape(-1, 3))
    values = values.cpu().unflatten(1, camera.image_size)
    valid = valid & (values[3] > 0.5)
    normals = (values[:3].movedim(0, -1) @ rotation).movedim(-1, 0)
    return torch.cat((1 / measured.where(valid, 1.0)[None], normals)), valid


def _sighted(
    points: Float[Tensor, "n 3"], camera: Camera, camera_from_world: Tensor, path: Path
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Pixels of the points that a depth image shows, and their rows."""
    steps = torch.from_numpy(read_pages(path)[0].astype(np.float64))
    local = points @ camera_from_world[:3, :3].mT + camera_from_world[:3, 3]
    pixels, valid = camera.to(torch.float64).project(local)
    if not isinstance(camera, EquirectangularCamera):
        valid = valid & (local[:, 2] > 0)  # where COLMAP's lenses end
    rows = valid.nonzero()[:, 0]
    column, row = pixels[rows].round().long().unbind(-1)
    height, width = camera.image_size
    visible = steps[row.clamp(0, height - 1), column.clamp(0, width - 1)] / MILLIMETRES
    distance = local[rows, 2] if isinstance(camera, PinholeCamera) else local[rows].norm(dim=-1)
    agree = (visible - distance).abs() <= AGREES * distance
    return pixels[rows][agree].numpy(), rows[agree].numpy()
