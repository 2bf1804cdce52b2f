# SPDX-License-Identifier: Apache-2.0
"""Small files that say that they are large: each is refused in words before there is memory for what it says."""

import base64
import io
import json
import os
import resource
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from sphericalvision.capture.calibrating.boards import AprilGrid, Charuco, Checkerboard, read_board
from sphericalvision.core import FileFormatError, SphericalVisionError, short_repr
from sphericalvision.data import truth_from_points
from sphericalvision.data.point_files import read_points
from sphericalvision.icosphere import Icosphere
from sphericalvision.io import files
from sphericalvision.io.arrays import read_npz
from sphericalvision.models import OmniMVS, load_weights, save_weights
from sphericalvision.scenes import read_mesh_scene
from tests.laws.network_laws import NETWORKS

MEGABYTES = 100


def gltf(folder: Path, count: int, packed: bool) -> Path:
    """A triangle, of whose points a number is stated and none is there."""
    ids = np.array([0, 1, 2], "<u4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(ids).decode()
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"uri": uri, "byteLength": len(ids)}],
        "bufferViews": [{"buffer": 0, "byteLength": 12}],
        "accessors": [
            {"componentType": 5126, "count": count, "type": "VEC3"},
            {"bufferView": 0, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
    }
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    path = folder / ("mesh.glb" if packed else "mesh.gltf")
    head = b"glTF" + np.array([2, 20 + len(text), len(text)], "<u4").tobytes() + b"JSON"
    path.write_bytes(head + text if packed else text)
    return path


def npz(folder: Path, stated: int, count: int) -> Path:
    """An array of bytes whose header states a number of them, and as many zeros as there are."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (stated,)})
    path = folder / "depth.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("depth.npy", header.getvalue() + bytes(count))
    return path


def target(folder: Path, columns: int) -> Path:
    path = folder / "target.yaml"
    path.write_text(
        f"target_type: checkerboard\ntargetCols: {columns}\ntargetRows: {columns}\n"
        "rowSpacingMeters: 0.03\ncolSpacingMeters: 0.03\n"
    )
    return path


def with_each_size(path: Path, name: str, value: Any) -> Iterator[str]:
    """Weights of a network at a path, which say of one whole number after the other that it is ``value``."""
    save_weights(NETWORKS[name].make(), path)
    with safe_open(path, "pt") as file:
        metadata, state = file.metadata(), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    sizes = json.loads(metadata["hyperparameters"])
    for key, given in sizes.items():
        if isinstance(given, int) and not isinstance(given, bool):
            save_file(state, path, metadata | {"hyperparameters": json.dumps(sizes | {key: value})})
            yield key


CASES: dict[str, Callable[[Path], Any]] = {
    "gltf": lambda folder: read_mesh_scene(gltf(folder, 10**8, packed=False)),
    "glb": lambda folder: read_mesh_scene(gltf(folder, 10**8, packed=True)),
    "target": lambda folder: read_board(target(folder, 9999)),
    "checkerboard": lambda _: Checkerboard(10**6, 10**6, 0.03),
    "more than int64": lambda _: Checkerboard(10**20, 7, 0.03),
    "charuco": lambda _: Charuco(10**6, 10**6, 0.03, 0.02),
    "tags": lambda _: AprilGrid(10**6, 10**6, 0.03, 0.3),
    "halvings": lambda _: OmniMVS(8, feature_channels=4, output_size=(32, 128), num_scales=2 * 10**10),
}


def grown_by(call: Callable[[], Any]) -> int:
    """Megabytes by which the largest size of the process grows meanwhile."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    call()
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10


def refused(call: Callable[[], Any]) -> Callable[[], None]:
    def checked() -> None:
        with pytest.raises(SphericalVisionError):
            call()

    return checked


@pytest.mark.parametrize("name", CASES)
def test_sizes_are_asked_before_memory(name: str, tmp_path: Path) -> None:
    assert grown_by(refused(lambda: CASES[name](tmp_path))) < MEGABYTES


@pytest.mark.parametrize("value", [10**9, 2 * 10**10, 2**63, -(10**9)])
@pytest.mark.parametrize("name", NETWORKS)
def test_every_hyperparameter_has_a_bound(name: str, value: int, tmp_path: Path) -> None:
    path, tried = tmp_path / "net.safetensors", 0
    for key in with_each_size(path, name, value):
        assert grown_by(refused(lambda: load_weights(path))) < MEGABYTES, key
        tried += 1
    assert tried


@pytest.mark.parametrize(("stated", "count"), [(3 * 10**8, 100), (100, 2**20), (2000, 2000)])
def test_an_array_is_as_large_as_both_the_archive_and_its_header_may_say(
    stated: int, count: int, tmp_path: Path
) -> None:
    with pytest.raises(FileFormatError):
        read_npz(npz(tmp_path, stated, count), ["depth"], 1999)
    assert read_npz(npz(tmp_path, 1000, 1000), ["depth"], 1999)["depth"].shape == (1000,)


def test_texture_of_scanned_points_is_not_opened(tmp_path: Path) -> None:
    """Neither outside of its folder nor a pipe, for whose end it would wait."""
    os.mkfifo(tmp_path / "pipe.png")
    axes = "".join(f"property float {axis}\n" for axis in "xyzst")
    for texture in ("pipe.png", "../outside.png"):
        (tmp_path / "scan.ply").write_text(
            f"ply\nformat ascii 1.0\ncomment TextureFile {texture}\nelement vertex 3\n{axes}element face 1\n"
            "property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n"
        )
        assert read_points(tmp_path / "scan.ply").tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def test_truth_of_parts_is_that_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    points = 2 * Icosphere(5).vertices
    whole = truth_from_points(points, Icosphere(3))
    assert whole.valid.sum() > 10
    monkeypatch.setattr("sphericalvision.data.truth.PART", 7)
    parts = truth_from_points(points, Icosphere(3))
    assert torch.equal(parts.depth, whole.depth)
    assert torch.equal(parts.valid, whole.valid)


def test_containers_leave_temporary_files_of_each_other_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Host names may be the same; what is a week old nobody writes any more."""
    monkeypatch.setattr(os, "readlink", lambda _: "pid:[1]")
    mine = files._machine()
    monkeypatch.setattr(os, "readlink", lambda _: "pid:[2]")
    assert mine != files._machine()
    names = [f".{mine}-1-{number:032x}.txt" for number in range(2)]
    for name in names:
        (tmp_path / name).write_text("half")
    os.utime(tmp_path / names[1], (0, 0))
    files.write_bytes(tmp_path / "new.txt", b"whole")
    assert {path.name for path in tmp_path.iterdir()} == {names[0], "new.txt"}


def test_short_texts_of_values_are_bounded() -> None:
    values: list[object] = ["lol"]
    for _ in range(30):
        values = [values] * 10
    for value in (values, {"a": values, "b": {1: values}}, "x" * 10**6, 10**5000, {k: k for k in range(999)}):
        assert 0 < len(short_repr(value)) <= 200
    assert short_repr([1, "two", None]) == "[1, 'two', None]"
