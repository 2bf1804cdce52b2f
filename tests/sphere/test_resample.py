# SPDX-License-Identifier: Apache-2.0
"""Resampling between icosphere, panorama and camera: identity, rotation, convergence, masks."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from sphericalvision.cameras import FisheyeCamera
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import Equirectangular, resample, resample_mask
from tests.laws.grid_laws import UP, rotation_about

FISHEYE = FisheyeCamera.from_field_of_view((96, 128), math.radians(200))


def test_camera_onto_itself_is_the_identity_in_view() -> None:
    image = torch.rand(3, 96, 128, dtype=torch.float64)
    camera = FISHEYE.to(torch.float64)
    seen = resample_mask(camera, camera)
    for mode in ("bilinear", "nearest"):
        result = resample(image, camera, camera, mode=mode, fill=-1.0)
        torch.testing.assert_close(result[:, seen], image[:, seen], rtol=0, atol=1e-9)
        assert (result[:, ~seen] == -1).all()
    assert 0.4 < seen.double().mean() < 0.7  # a circle of diameter 96 in 96 x 128


@pytest.mark.parametrize("shift", [1, 5, -3])
def test_convention_rotation_turns_the_content(shift: int) -> None:
    """rotation is target_from_source: by whole columns to the right, a panorama rolls to the right."""
    grid = Equirectangular(8, 16, dtype=torch.float64)
    image = torch.rand(3, 8, 16, dtype=torch.float64)
    turned = resample(image, grid, grid, rotation_about(-UP, shift * 2 * math.pi / 16))
    torch.testing.assert_close(turned, image.roll(shift, -1), rtol=0, atol=1e-12)


def test_golden_panorama(golden: Path) -> None:
    """Level 3 to 30 x 60: the same where the reference uses the containing face, near it elsewhere."""
    numbers = np.load(golden / "image_io.npz")
    ico, grid = Icosphere(3, dtype=torch.float64), Equirectangular(30, 60, dtype=torch.float64)
    values = torch.from_numpy(numbers["erp_in"]).double()[None, ico.subdivision_order]
    expected = torch.from_numpy(numbers["erp_out"]).double()
    difference = (resample(values, ico, grid)[0] - expected).abs()
    assert difference.median() < 2e-3

    structured = ico.subdivision_order.argsort()[torch.from_numpy(numbers["erp_ids"]).long().T]
    weights = torch.from_numpy(numbers["erp_w"]).double().T
    faces = {tuple(face) for face in ico.faces.sort().values.tolist()}
    is_face = torch.tensor([tuple(ids) in faces for ids in structured.sort().values.tolist()])
    contained = is_face & (weights.amin(-1) > 0)
    assert contained.double().mean() > 0.8
    meant = (ico.vertices[structured] * weights[..., None]).sum(1)
    towards = torch.nn.functional.normalize(meant, dim=-1)
    assert (towards - grid.directions.view(-1, 3)).norm(dim=-1)[contained].max() < 0.02
    torch.testing.assert_close(
        ico.sample(values, meant[contained])[0], expected.flatten()[contained], rtol=0, atol=1e-5
    )
