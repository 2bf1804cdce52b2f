# SPDX-License-Identifier: Apache-2.0
"""Files of a depth estimate hold what the cameras saw."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from sphericalvision.cameras import ring_rig
from sphericalvision.capture.outputs import Outputs
from sphericalvision.capture.result_folder import Settings
from sphericalvision.capture.writers import OUTPUTS
from sphericalvision.core import ArgumentError
from sphericalvision.io.images import read_image
from tests.worlds import ball


def test_every_output_is_what_it_says(tmp_path: Path) -> None:
    rig = ring_rig(3, image_size=(16, 16))
    depth = ball(rig)
    # Of sequences; tests/capture has those
    kinds = [kind for kind in OUTPUTS if kind not in ("timeline", "rerun")]
    outputs = Outputs(tmp_path, Settings(kinds, 32, min_confidence=0.25, voxel=0.1))
    outputs.write("7", depth)
    outputs.close()
    assert outputs.count == 1
    names = (
        "7_color.png 7_depth.png 7_confidence.png depth.mp4 7_panorama.png panorama.mp4 7_depth.npz consistency.csv "
        "7_points.ply 7_points.glb 7_mesh.ply 7_mesh.glb fused.ply fused.glb 7_viewer.html "
        "points3D.ply points3D.bin transforms.json"  # of both folders of splat
    )
    assert {path.name for path in outputs.written} == set(names.split())
    assert all(path.is_file() for path in outputs.written)
    assert not torch.equal(read_image(tmp_path / "7_depth.png"), read_image(tmp_path / "7_confidence.png"))
    assert outputs.results.fused is not None
    assert outputs.results.fused.side == 0.1
    expected = depth.points(0.25, voxel=0.1)
    cloud = trimesh.load(tmp_path / "7_points.ply")
    np.testing.assert_allclose(cloud.vertices, expected.points, atol=1e-6)
    stored = cloud.metadata["_ply_raw"]["vertex"]["data"]
    normals = np.stack([stored[f"n{axis}"] for axis in "xyz"], -1).reshape(-1, 3)
    np.testing.assert_allclose(normals, expected.normals, atol=1e-6)
    (upright,) = trimesh.load(tmp_path / "7_points.glb").geometry.values()
    np.testing.assert_allclose(upright.vertices, expected.points * torch.tensor([1, -1, -1]), atol=1e-6)
    surface = trimesh.load(tmp_path / "7_mesh.ply")
    np.testing.assert_allclose(np.linalg.norm(surface.vertices[surface.faces], axis=-1), 2.0, atol=1e-3)
    with np.load(tmp_path / "7_depth.npz") as arrays:
        np.testing.assert_allclose(arrays["depth_panorama"], 2.0, rtol=1e-4)
        np.testing.assert_allclose(arrays["depth"], 2.0, rtol=1e-4)
        np.testing.assert_allclose(arrays["directions"], depth.directions)
        assert arrays["confidence_panorama"].max() <= 1


def test_files_are_in_the_axes_of_a_robot_but_those_with_axes_of_their_own(tmp_path: Path) -> None:
    axes = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    for name, turn in (("rig", None), ("robot", axes)):
        settings = Settings(["cloud", "mesh", "fused", "glb"], 16, near=1.0, axes=turn)
        outputs = Outputs(tmp_path / name, settings)
        outputs.write("7", ball(ring_rig(3, image_size=(16, 16))))
        outputs.close()
    for file in ("7_points.ply", "7_mesh.ply", "fused.ply", "7_points.glb", "7_mesh.glb", "fused.glb"):
        found = [trimesh.load(tmp_path / name / file, process=False) for name in ("rig", "robot")]
        if file.endswith("glb"):
            found = [next(iter(scene.geometry.values())) for scene in found]
        rig, robot = (np.asarray(each.vertices) for each in found)
        np.testing.assert_allclose(robot, rig if file.endswith("glb") else rig @ axes.numpy().T, atol=1e-5)


def test_unknown_outputs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"outputs: expected one of .*'depth'"):
        Outputs(tmp_path, Settings(["depth", "voxels"]))


def test_a_fused_cloud_says_which_frames_it_has_even_if_nobody_closed_it(tmp_path: Path) -> None:
    depth = ball(ring_rig(3, image_size=(16, 16)))
    Outputs(tmp_path, Settings(["fused"], 32)).write("7", depth)
    again = Outputs(tmp_path, Settings(["fused"], 32, go_on=True))
    assert [again.has(name) for name in ("7", "8")] == [True, False]
