# SPDX-License-Identifier: Apache-2.0
"""Meshes as scenes: exact depth and colours of all kinds."""

import json
import math
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("embreex")
trimesh = pytest.importorskip("trimesh")
Image = pytest.importorskip("PIL.Image")

from sphericalvision.cameras import EquirectangularCamera  # noqa: E402
from sphericalvision.core import FileFormatError, MissingFileError  # noqa: E402
from sphericalvision.scenes import (  # noqa: E402
    MeshScene,
    ray_depth,
    read_mesh_scene,
    render_camera,
    render_directions,
)
from sphericalvision.scenes.rendering import mesh_scene  # noqa: E402

ORIGIN = torch.zeros(3)
UP, RIGHT, FORWARD = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def directions(count: int, seed: int = 0) -> torch.Tensor:
    return torch.nn.functional.normalize(
        torch.randn(count, 3, generator=torch.Generator().manual_seed(seed)), dim=-1
    )


def test_depth_in_a_box_is_that_of_the_closed_form() -> None:
    half, rays = torch.tensor([2.0, 1.5, 3.0]), directions(2000)
    mesh = trimesh.creation.box(2 * half.numpy())
    depth = ray_depth(MeshScene(mesh), ORIGIN, rays.view(20, 100, 3))
    torch.testing.assert_close(depth.flatten(), (half / rays.abs()).amin(-1), rtol=1e-5, atol=1e-5)
    inches = MeshScene(mesh, scale=0.0254)
    torch.testing.assert_close(ray_depth(inches, ORIGIN, rays), 0.0254 * depth.flatten())
    aside = ray_depth(MeshScene(mesh, center=(0.5, 0.25, -1.0)), ORIGIN, torch.stack([RIGHT, UP, FORWARD]))
    assert aside.tolist() == pytest.approx([1.5, 1.25, 2.0])  # z of the file points backward


@pytest.mark.parametrize(("up", "axis"), [("y", 1), ("z", 2)])
def test_up_in_the_file_is_up_in_the_world_and_nothing_is_mirrored(up: str, axis: int) -> None:
    """Three balls on the file's axes: the one above is above, and the three keep their handedness."""
    places = 3.0 * np.eye(3)
    balls = [trimesh.creation.icosphere(radius=0.5).apply_translation(p) for p in places]
    scene = MeshScene(trimesh.util.concatenate(balls), up=up)
    found = torch.stack([torch.from_numpy(scene.vertices[k * 642 : (k + 1) * 642]).mean(0) for k in range(3)])
    torch.testing.assert_close(found[axis].float(), 3 * UP, rtol=0, atol=1e-5)
    assert torch.linalg.det(found) > 0
    assert ray_depth(scene, ORIGIN, UP).item() == pytest.approx(2.5, abs=1e-3)
    assert ray_depth(scene, ORIGIN, -UP).isinf()


def quad(visual: Any = None) -> Any:
    """A square of 2 m, 1 m in front of the origin (in the file, -z is forward)."""
    vertices = [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]]
    return trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_textures_and_colours_are_where_they_belong(suffix: str, tmp_path: Path) -> None:
    """Red above, green below to the left, blue below to the right, as seen from the origin."""
    if suffix == ".ply":  # has colours of vertices
        colors = [[0, 255, 0, 255], [0, 0, 255, 255], [255, 0, 0, 255], [255, 0, 0, 255]]
        mesh = quad()
        mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colors)
    else:
        uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
        mesh = quad(trimesh.visual.TextureVisuals(uv=uv, image=FOUR))
    mesh.export(tmp_path / f"quad{suffix}")
    scene = read_mesh_scene(tmp_path / f"quad{suffix}")
    spots = torch.tensor([[-0.9, -0.9, 1.0], [0.9, -0.9, 1.0], [-0.9, 0.9, 1.0], [0.9, 0.9, 1.0]])
    rays = torch.nn.functional.normalize(spots, dim=-1)
    seen = render_directions(scene, ORIGIN, rays)
    assert seen.argmax(0).tolist() == [0, 0, 1, 2]
    assert seen.amax(0).min() > 0.9
    torch.testing.assert_close(ray_depth(scene, ORIGIN, rays), spots.norm(dim=-1), rtol=1e-5, atol=1e-5)
    assert (render_directions(scene, ORIGIN, -rays) == 0).all()


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_surfaces_that_meet_keep_their_colours(suffix: str, tmp_path: Path) -> None:
    """Three sides of a box, each of one colour: corners in one place have three colours; none is bare or at NaN."""
    box = trimesh.creation.box((4.0, 4.0, 4.0))
    box.unmerge_vertices()
    colors = np.abs(np.repeat(box.face_normals, 3, 0)).round() * 255
    vertices, colors = np.vstack((box.vertices, [[50, 0, 0]])), np.vstack((colors, [[9, 9, 9]]))
    if suffix == ".ply":
        vertices, colors = np.vstack((vertices, [[np.nan] * 3])), np.vstack((colors, [[9, 9, 9]]))
    mesh = trimesh.Trimesh(vertices, box.faces, vertex_colors=colors.astype(np.uint8), process=False)
    mesh.export(tmp_path / f"box{suffix}")
    scene = read_mesh_scene(tmp_path / f"box{suffix}")
    assert np.abs(scene.vertices).max() == 2.0
    torch.testing.assert_close(render_directions(scene, ORIGIN, torch.eye(3)), torch.eye(3))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", ("uchar red", "4 0 1 2 3 255"), "1 colours are of polygons, which are 2 triangles"),
        ("b.ply", ("ushort red", "3 0 1 2 9"), "its colours are ushort 'red'"),
        ("c.ply", ("uchar diffuse_red", "3 0 1 2 9"), "its colours are uchar 'diffuse_red'"),
        ("d.ply", ("comment TextureFile", "3 0 1 2"), "it has 2 textures, of which one is read"),
        ("e.off", ("OFF", "4 0 1 2 3 255 0 0"), "colours of OFF files are not read"),
        ("f.off", ("COFF", "4 0 1 2 3"), "colours of OFF files are not read"),
    ],
)
def test_colours_that_would_be_lost_are_refused(
    name: str, content: tuple[str, str], message: str, tmp_path: Path
) -> None:
    kind, face = content
    corners = "-1 -1 -1\n1 -1 -1\n1 1 -1\n-1 1 -1\n"
    if name.endswith(".off"):
        text = f"{kind}\n4 1 0\n{corners}{face}\n"
    else:
        colours = "".join(f"property {kind.replace('red', word)}\n" for word in ("red", "green", "blue"))
        header = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        header += "element face 1\nproperty list uchar int vertex_indices\n"
        header += "".join(f"{kind} {k}.png\n" for k in "ab") if kind.startswith("comment") else colours
        face += face[face.rindex(" ") :] * 2 * (not kind.startswith("comment"))
        text = f"ply\nformat ascii 1.0\n{header}end_header\n{corners}{face}\n"
    (tmp_path / name).write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_mesh_scene(tmp_path / name)


def test_any_camera_takes_pictures_of_a_mesh() -> None:
    """Depth and colour of a ball of one colour, through a panorama."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0).apply_translation((0, 0, -3))
    ball.visual.face_colors = [200, 100, 50, 255]
    picture = render_camera(MeshScene(ball), EquirectangularCamera((64, 128)), torch.eye(4), 4)
    inside = picture[:, 32, 64]
    assert inside.tolist() == pytest.approx([200 / 255, 100 / 255, 50 / 255], abs=2e-3)
    share = (picture.amax(0) > 0).float().mean().item()
    radius = math.asin(1 / 3)  # a disc of this angular radius at the middle, where pixels are nearly square
    assert share == pytest.approx(math.pi * radius**2 / (2 * math.pi * math.pi), rel=0.15)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("room.glb", None),
        ("room.txt", b""),
        ("damaged.glb", b"nothing of the kind"),
        ("damaged.ply", b"nothing of the kind"),
        ("flat.obj", b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n"),
        ("points.ply", trimesh.PointCloud(np.eye(3)).export(file_type="ply")),
    ],
)
def test_what_is_no_mesh_is_refused_by_name(name: str, content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(MissingFileError if content is None else FileFormatError, match=name):
        read_mesh_scene(tmp_path / name)


def quad_with_texture(folder: Path, named: str) -> Path:
    """A square 1 m in front of the origin whose material names a texture."""
    folder.mkdir(exist_ok=True)
    (folder / "quad.mtl").write_text(f"newmtl paper\nmap_Kd {named}\n")
    corners = "v -1 -1 -1\nv 1 -1 -1\nv 1 1 -1\nv -1 1 -1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    text = f"mtllib quad.mtl\n{corners}usemtl paper\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    (folder / "quad.obj").write_text(text)
    return folder / "quad.obj"


def in_front(scene: MeshScene) -> list[float]:
    return render_directions(scene, ORIGIN, FORWARD[None])[:, 0].tolist()


RED, FOUR = (Image.new("RGB", (side, side), (255, 0, 0)) for side in (2, 64))
FOUR.paste((0, 255, 0), (0, 32, 32, 64))  # below to the left
FOUR.paste((0, 0, 255), (32, 32, 64, 64))


@pytest.mark.parametrize(
    "named", ["red%20paint.png", "C:\\scans\\red paint.png", "pictures/../red paint.png"]
)
def test_textures_below_the_folder_are_found_however_they_are_named(named: str, tmp_path: Path) -> None:
    RED.save(tmp_path / "red paint.png")
    assert in_front(read_mesh_scene(quad_with_texture(tmp_path, named))) == pytest.approx([1.0, 0.0, 0.0])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("way", ["missing", "above", "absolute", "link", "pipe", "damaged", "huge"])
def test_textures_that_cannot_be_had_are_told_and_never_read(way: str, tmp_path: Path) -> None:
    """None outside of the mesh's folder, nothing that is waited for in vain, nothing that fills the memory."""
    RED.save(tmp_path / "secret.png")
    folder = tmp_path / "mesh"
    named = {"above": "../secret.png", "absolute": str(tmp_path / "secret.png")}.get(way, f"{way}.png")
    path = quad_with_texture(folder, named)
    if way == "link":
        (folder / named).symlink_to(tmp_path / "secret.png")
    elif way == "pipe":
        os.mkfifo(folder / named)
    elif way == "damaged":
        (folder / named).write_bytes(b"no picture")
    elif way == "huge":  # a header is enough
        header = b"IHDR" + struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
        checked = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
        (folder / named).write_bytes(b"\x89PNG\r\n\x1a\n" + checked)
    with pytest.warns(UserWarning, match=r"quad\.obj: what it names could not be read.*folder of the mesh"):
        scene = read_mesh_scene(path)
    red, green, blue = in_front(scene)
    assert red == green == blue


@pytest.mark.parametrize("uri", ["../secret.bin", "/etc/passwd"])
def test_buffers_come_from_the_folder_of_the_mesh_alone(uri: str, tmp_path: Path) -> None:
    tree = instances(tmp_path / "mesh", 1)
    (tmp_path / "mesh" / tree["buffers"][0]["uri"]).rename(tmp_path / "secret.bin")
    tree["buffers"][0]["uri"] = uri
    (tmp_path / "mesh/scene.gltf").write_text(json.dumps(tree))
    with pytest.raises(FileFormatError, match=r"cannot be read as a mesh.*no such file below"):
        read_mesh_scene(tmp_path / "mesh/scene.gltf")


def instances(folder: Path, count: int, specular: bool = False) -> dict[str, Any]:
    """``scene.gltf``: the same textured square in many places; returns what it holds."""
    folder.mkdir(exist_ok=True)
    textured = quad(trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], image=RED))
    files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(textured))
    tree: dict[str, Any] = json.loads(files.pop("model.gltf"))
    for name, content in files.items():
        (folder / name).write_bytes(content)
    if specular:
        (material,) = tree["materials"]
        colours = {"diffuseTexture": material.pop("pbrMetallicRoughness")["baseColorTexture"]}
        material["extensions"] = {"KHR_materials_pbrSpecularGlossiness": colours}
    tree["nodes"] = [{"mesh": 0, "name": str(k), "translation": [0.0, 0.0, -k]} for k in range(count)]
    tree["scenes"] = [{"nodes": list(range(count))}]
    (folder / "scene.gltf").write_text(json.dumps(tree))
    return tree


@pytest.mark.parametrize("specular", [False, True])
def test_a_piece_in_many_places_is_kept_once_and_counted_often(
    specular: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trimesh.visual.gloss.specular_to_pbr", None)  # unpacks textures of any size
    instances(tmp_path, 30, specular)
    scene = read_mesh_scene(tmp_path / "scene.gltf")
    assert (len(scene.textures), len(scene.faces)) == (1, 60)
    assert in_front(scene) == pytest.approx([1.0, 0.0, 0.0])
    forward = np.sort(scene.vertices.reshape(30, 4, 3)[:, :, 2], 0)
    np.testing.assert_allclose(forward, 1.0 + np.arange(30)[:, None].repeat(4, 1))
    for name, most, word in (("MOST_TRIANGLES", 59, "59.*found 60"), ("MOST_PIXELS", 3, "3 pixels.*found 4")):
        with monkeypatch.context() as patch:
            patch.setattr(mesh_scene, name, most)
            with pytest.raises(FileFormatError, match=rf"scene\.gltf.*{word}"):
                read_mesh_scene(tmp_path / "scene.gltf")


CORNERS = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]], np.float32)
SHADE = np.tile(np.array([[0.5, 0.25, 0.0]]), (4, 1))
PICTURE = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
KINDS = {"float32": 5126, "uint32": 5125, "uint16": 5123, "int16": 5122, "uint8": 5121}


def square(
    folder: Path, attributes: dict[str, Any], material: Any = None, suffix: str = ".gltf", **more: Any
) -> Path:
    """A square 1 m in front of the origin; whole numbers of its corners stand for shares. RED lies beside it."""
    nodes = {"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    tree: dict[str, Any] = {"asset": {"version": "2.0"}, **nodes, **more}
    places: dict[str, int] = {}
    tree["accessors"], tree["bufferViews"], content = [], [], b""
    for name, values in {**attributes, "indices": np.array([0, 1, 2, 0, 2, 3], np.uint32)}.items():
        places[name] = len(tree["accessors"])
        shape = {"count": len(values), "type": "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"}
        normalized = values.dtype.kind != "f" and values.ndim > 1
        kind = {"componentType": KINDS[values.dtype.name], "normalized": normalized}
        tree["accessors"].append({"bufferView": places[name], **kind, **shape})
        tree["bufferViews"].append({"buffer": 0, "byteOffset": len(content), "byteLength": values.nbytes})
        content += values.tobytes()
    primitive: dict[str, Any] = {"indices": places.pop("indices"), "attributes": places}
    if material is not None:
        tree["materials"], primitive["material"] = [{"pbrMetallicRoughness": material}], 0
        tree["images"], tree["textures"] = [{"uri": "four.png"}], [{"source": 0}]
        FOUR.save(folder / "four.png")
    tree["meshes"], tree["buffers"] = [{"primitives": [primitive]}], [{"byteLength": len(content)}]
    if suffix == ".gltf":
        (folder / "buffer.bin").write_bytes(content)
        tree["buffers"][0]["uri"] = "buffer.bin"
        text = json.dumps(tree).encode()
    else:
        inside = json.dumps(tree).encode()
        inside += b" " * (-len(inside) % 4)
        lengths = (2, 28 + len(inside) + len(content), len(inside), len(content))
        sizes = [length.to_bytes(4, "little") for length in lengths]
        text = b"glTF" + sizes[0] + sizes[1] + sizes[2] + b"JSON" + inside + sizes[3] + b"BIN\0" + content
    (folder / f"square{suffix}").write_bytes(text)
    return folder / f"square{suffix}"


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
@pytest.mark.parametrize("kind", ["float32", "uint8"])
def test_colours_of_a_gltf_are_multiplied_as_its_specification_says(
    kind: str, suffix: str, tmp_path: Path
) -> None:
    most = 1.0 if kind == "float32" else float(np.iinfo(kind).max)
    colors = (SHADE * most).round().astype(kind) if most > 1 else SHADE.astype(np.float32)
    grey = {"baseColorFactor": [0.5, 0.5, 0.5, 1.0]}

    def light(attributes: dict[str, Any], material: Any) -> list[float]:
        path = square(tmp_path, {"POSITION": CORNERS, **attributes}, material, suffix)
        return read_mesh_scene(path).light(ORIGIN, FORWARD[None])[0].tolist()

    assert light({"COLOR_0": colors}, {}) == pytest.approx(SHADE[0], abs=5e-3)
    assert light({"COLOR_0": colors}, grey) == pytest.approx(SHADE[0] / 2, abs=5e-3)
    assert light({}, grey) == pytest.approx([0.5] * 3, abs=5e-3)
    assert light({}, {}) == [1.0] * 3
    # As trimesh writes them
    assert light({"COLOR_0": colors}, None) == pytest.approx(SHADE[0] ** 2.2, abs=5e-3)


@pytest.mark.parametrize(
    ("corners", "texture"),
    [
        ({"POSITION": (CORNERS * 32767).astype(np.int16)}, {}),
        ({"COLOR_0": (SHADE * 65535).astype(np.uint16)}, {}),
        ({"TEXCOORD_0": (PICTURE * 65535).astype(np.uint16)}, {}),
        ({"TEXCOORD_0": PICTURE, "TEXCOORD_1": PICTURE}, {"texCoord": 1}),
        ({"TEXCOORD_0": PICTURE}, {"extensions": {"KHR_texture_transform": {"scale": [0.5, 0.5]}}}),
    ],
)
def test_what_trimesh_reads_wrongly_of_a_gltf_is_refused(corners: Any, texture: Any, tmp_path: Path) -> None:
    material = {"baseColorTexture": {"index": 0, **texture}}
    path = square(tmp_path, {"POSITION": CORNERS, **corners}, material)
    with pytest.raises(FileFormatError, match=r"square\.gltf"):
        read_mesh_scene(path)


def test_what_a_gltf_needs_is_read_or_refused(tmp_path: Path) -> None:
    for name in ("EXT_meshopt_compression", "KHR_mesh_quantization", "KHR_draco_mesh_compression"):
        path = square(tmp_path, {"POSITION": CORNERS}, extensionsRequired=[name])
        with pytest.raises(
            FileFormatError, match=r"square\.gltf: it (needs the extension|is compressed by Draco)"
        ):
            read_mesh_scene(path)
    tree = json.loads(square(tmp_path, {"POSITION": CORNERS}).read_text())
    tree["accessors"][0]["sparse"] = {"count": 1}
    path.write_text(json.dumps(tree))
    with pytest.raises(FileFormatError, match="sparse"):
        read_mesh_scene(path)
