# SPDX-License-Identifier: Apache-2.0
"""Where errors count, against plain loops and a dense walk along the seams; the official protocol written out."""

import math

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig, seen_by
from sphericalvision.icosphere import Icosphere, icosphere_vertices
from sphericalvision.icosphere.topology import chart_vertex_ids
from sphericalvision.metrics import (
    ByRegion,
    DepthError,
    DepthIndexError,
    OmniMVSError,
    depth_index_error,
    evaluation_mask,
    omnimvs_error,
    seam_mask,
)
from tests.metrics.test_depth_errors import loop_index_errors


def count_by_loops(rig: CameraRig, directions: Tensor, inverse_depth: Tensor) -> Tensor:
    """Each point and camera by itself; far points at 1e6 m."""
    counts = torch.zeros(len(directions), dtype=torch.long)
    for v, (direction, inverse) in enumerate(zip(directions.double(), inverse_depth.tolist(), strict=True)):
        point = rig.center.double() + direction / max(inverse, 1e-6)
        for pose, limit in zip(rig.world_from_camera.double(), rig.max_angles.double(), strict=True):
            ray = point - pose[:3, 3]
            angle = math.acos(max(-1.0, min(1.0, float(ray @ pose[:3, 2] / ray.norm()))))
            counts[v] += angle <= limit
    return counts


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_cameras_that_see_a_point_are_counted(tilt: float, generator: torch.Generator) -> None:
    rig = ring_rig(4, image_size=(64, 64)).rotated(tilt=tilt)
    directions = Icosphere(2).vertices
    inverse_depth = torch.rand(2, len(directions), generator=generator) / 0.55
    inverse_depth[0, :40] = 0.0
    expected = torch.stack([count_by_loops(rig, directions, row) for row in inverse_depth])
    assert torch.equal(seen_by(rig, directions, inverse_depth), expected)
    batch = CameraRig.stack([rig, rig.rotated(tilt=0.3)])
    both = seen_by(batch, directions, inverse_depth)
    assert torch.equal(both[0], expected[0])
    assert torch.equal(both[1], count_by_loops(rig.rotated(tilt=0.3), directions, inverse_depth[1]))


def test_what_fewer_than_two_see_is_left_out_and_the_share_is_told(generator: torch.Generator) -> None:
    rig, grid = ring_rig(4).rotated(tilt=math.radians(45)), Icosphere(3)
    inverse_depth = torch.rand(2, grid.num_vertices, generator=generator)
    valid = torch.rand(2, grid.num_vertices, generator=generator) > 0.2
    unknown = torch.where(valid, inverse_depth, torch.nan)
    mask, left_out = evaluation_mask(rig, grid.vertices, unknown, valid)
    seen = seen_by(rig, grid.vertices, inverse_depth) >= 2
    assert torch.equal(mask, seen & valid)
    for row in range(2):
        share = sum(v and not s for v, s in zip(valid[row].tolist(), seen[row].tolist(), strict=True))
        assert left_out[row].item() == pytest.approx(share / valid[row].sum().item())
    assert not mask[:, 0].any()  # nobody looks up
    everything = evaluation_mask(ring_rig(4), grid.vertices, inverse_depth)
    assert everything.mask.all()
    assert (everything.left_out == 0).all()


def seam_points() -> Tensor:
    """Points along the seams, a hundredth of a degree apart on the meridian, vertices of level 9 along the charts."""
    latitude = torch.linspace(-math.pi / 2, math.pi / 2, 18001, dtype=torch.float64)
    meridian = torch.stack((torch.zeros_like(latitude), latitude.sin(), -latitude.cos()), -1)
    ids = chart_vertex_ids(9)
    border = torch.cat(
        [ids[:, 0].flatten(), ids[:, -1].flatten(), ids[..., 0].flatten(), ids[..., -1].flatten()]
    )
    return torch.cat((meridian, icosphere_vertices(9, torch.float64)[border]))


@pytest.mark.parametrize("degrees", [2.0, 5.0, 20.0])
def test_seams_are_where_the_borders_are(degrees: float, generator: torch.Generator) -> None:
    directions = torch.randn(400, 3, generator=generator, dtype=torch.float64)
    unit = directions / directions.norm(dim=-1, keepdim=True)
    nearest = torch.cdist(unit, seam_points(), compute_mode="donot_use_mm_for_euclid_dist").amin(1)
    angle = 2 * (nearest / 2).asin()
    certain = (angle - math.radians(degrees)).abs() > 1e-3
    mask = seam_mask(directions, math.radians(degrees))
    assert torch.equal(mask[certain], (angle < math.radians(degrees))[certain])
    if degrees == 5.0:
        assert torch.equal(seam_mask(directions), mask)


def official_by_loops(pred: Tensor, target: Tensor, min_depth: float, mask: Tensor) -> dict[str, float]:
    """Rows within 45 degrees, N = 192, index not rounded, 0 <= index <= N; then per image, then over images."""
    height = pred.shape[1]
    rows = [row for row in range(height) if abs(90 - (row + 0.5) * 180 / height) < 45]
    index, truth = (191 * min_depth * values[:, rows].flatten(1) for values in (pred, target))
    return loop_index_errors(index, truth, mask[:, rows].flatten(1) & (truth >= 0) & (truth <= 192), 192)


def test_the_official_protocol_equals_loops(generator: torch.Generator) -> None:
    # Up to 0.5 m: some are nearer than the 0.55 m of N
    target = torch.rand(3, 16, 32, generator=generator) * 2.0
    pred = target + 0.05 * torch.randn(3, 16, 32, generator=generator)
    mask = torch.rand(3, 16, 32, generator=generator) > 0.3
    metric = OmniMVSError()
    metric.update(pred[:1], target[:1], mask[:1])
    metric.update(pred[1:], target[1:], mask[1:])
    values = {name: value.item() for name, value in metric.compute().items()}
    assert values == pytest.approx(official_by_loops(pred, target, 0.55, mask), rel=1e-4)
    band = omnimvs_error(pred[:, 4:12], target[:, 4:12], 0.55, mask[:, 4:12])  # 4:1, as the urban sets
    torch.testing.assert_close(band, omnimvs_error(pred, target, 0.55, mask))


def test_regions_are_masks(generator: torch.Generator) -> None:
    grid = Icosphere(3)
    seam = seam_mask(grid.vertices)
    pred, target = torch.rand(2, 3, grid.num_vertices, generator=generator).unbind()
    mask = torch.rand(3, grid.num_vertices, generator=generator) > 0.4
    metric = ByRegion(DepthIndexError(16), {"seam": seam, "elsewhere": ~seam})
    metric.update(pred[:2], target[:2], mask[:2])
    metric.update(pred[2:], target[2:], mask[2:], weights=torch.ones(grid.num_vertices))
    values = metric.compute()
    for prefix, region in (("", seam | True), ("seam/", seam), ("elsewhere/", ~seam)):
        alone = depth_index_error(pred, target, 16, mask & region)
        for name, errors in alone.items():
            assert values[f"{prefix}{name}"].item() == pytest.approx(errors.mean().item(), rel=1e-5)
    metric.reset()
    metric.update(pred, pred)
    assert all(value == 0 for value in metric.compute().values())
    depths = ByRegion(DepthError(), {"seam": seam})
    depths.update(pred + 1, target + 1)
    assert {"AbsRel", "RMSE", "d<1.25", "seam/AbsRel", "seam/RMSE", "seam/d<1.25"} == set(depths.compute())
