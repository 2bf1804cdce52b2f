# SPDX-License-Identifier: Apache-2.0
"""A rig of the original authors' data format: the pixels at which their implementation looks icosphere vertices up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sphericalvision.cameras import read_rig, sample_sphere


def test_pixels_of_vertices_agree_with_the_reference(golden: Path) -> None:
    """The reference keeps float32 pixels, whose last place is 6e-5 at 1000 px."""
    rig = read_rig(golden / "rig", translation_unit="cm", dtype=torch.float64)
    vertices = torch.from_numpy(np.load(golden / "icosahedron.npz")["v4"])
    reference = np.load(golden / "image_io.npz")
    poses = rig.world_from_camera[:, :3, :3]
    for number, (camera, pose) in enumerate(zip(rig.cameras.values(), poses, strict=True), start=1):
        pixels, valid = camera.project(vertices @ pose)
        expected = np.stack([reference[f"mapx_cam{number}"], reference[f"mapy_cam{number}"]], -1)
        assert valid.sum() > 1500
        np.testing.assert_allclose(pixels[valid], expected[valid.numpy()], rtol=0, atol=6e-5)


def test_poses_agree_with_the_reference(golden: Path) -> None:
    rig = read_rig(golden / "rig", translation_unit="cm", dtype=torch.float64)
    sweep = np.load(golden / "sweep.npz")
    np.testing.assert_allclose(rig.center, np.asarray(sweep["center"]).ravel(), atol=1e-6)
    expected = np.asarray(sweep["poses_cw"])
    np.testing.assert_allclose(rig.camera_from_world[:, :3], expected[:, :3], atol=1e-6)


def test_images_on_the_sphere_agree_with_the_reference(golden: Path) -> None:
    """The reference samples 8-bit images in fixed point: a grey level of difference, and its fill at the border."""
    cv2 = pytest.importorskip("cv2")
    rig = read_rig(golden / "rig", translation_unit="cm")
    vertices = torch.from_numpy(np.load(golden / "icosahedron.npz")["v4"]).float()
    reference = np.load(golden / "image_io.npz")
    images = []
    for number, camera in enumerate(rig.cameras.values(), start=1):
        height, width = camera.image_size
        small = reference[f"img_lowres_cam{number}"]
        large = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
        images.append(torch.from_numpy(large).movedim(-1, 0).float())
    values, valid = sample_sphere(rig, images, vertices, fill=128.0)
    for index in range(len(rig)):
        expected = torch.from_numpy(reference[f"ico_cam{index + 1}"]).float().T
        difference = (values[index] - expected).abs().amax(0)
        assert difference[valid[index]].quantile(0.99) <= 1.01
