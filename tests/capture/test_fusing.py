# SPDX-License-Identifier: Apache-2.0
"""Fused clouds: means of what frames agree on, nothing that they see through, the same after a pause."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from sphericalvision.capture import DepthImage, fusing
from sphericalvision.capture.fusing import FusedCloud
from sphericalvision.capture.points import SurfacePoints
from sphericalvision.core import FileFormatError
from sphericalvision.sphere import Equirectangular

GRID = Equirectangular(48, 96)
HALF = 1.5
"""Of the sides of a hall around the world's origin, metres."""


def cloud(points: torch.Tensor, confidence: float = 0.5) -> SurfacePoints:
    sides = torch.nn.functional.one_hot(points.abs().argmax(-1), 3) * -points.sign()
    return SurfacePoints(points, points / 4 + 0.5, sides, torch.full((len(points),), confidence))


def hall(center: torch.Tensor) -> DepthImage:
    """Exact depth of its walls from a place in it."""
    rays = GRID.directions
    depth = ((HALF * rays.sign() - center) / rays).where(rays != 0, torch.inf).amin(-1)
    return DepthImage(depth, torch.ones(GRID.shape), torch.ones(GRID.shape, dtype=torch.bool))


def fused(number: int, ghost: torch.Tensor, ghosts: int, fuse: FusedCloud | None = None) -> FusedCloud:
    """Frames in the hall, the first of which have a ghost in the middle of it as well."""
    result = FusedCloud(0.2) if fuse is None else fuse
    for frame in range(number):
        center = torch.tensor([0.1 * frame - 0.3, 0.05, 0.2])
        depth = hall(center)
        points = (center + GRID.directions * depth.depth[..., None]).flatten(0, 1)
        points = points * (1 - 1e-3)  # not on the edge of cubes
        points = torch.cat((points, ghost)) if frame < ghosts else points
        result.add(f"{frame:02d}", cloud(points), depth, center)
    return result


def near_ghost(found: SurfacePoints, ghost: torch.Tensor) -> bool:
    return bool(((found.points - ghost).norm(dim=-1) < 0.2).any())


def test_walls_stay_and_what_most_frames_see_through_does_not() -> None:
    ghost = torch.tensor([[0.3, 0.1, 0.9]])
    found = fused(4, ghost, 2).points()
    assert len(found.points) > 200
    assert not near_ghost(found, ghost)  # only two have it
    inside = found.points.abs().topk(2).values[:, 1] < HALF - 0.2  # away from the edges of the hall
    assert (found.points.abs().amax(-1) - HALF).abs()[inside].max() < 0.01
    expected = -torch.nn.functional.one_hot(found.points.abs().argmax(-1), 3) * found.points.sign()
    assert ((found.normals * expected).sum(-1)[inside] > 0.99).all()
    torch.testing.assert_close(found.colors, found.points / 4 + 0.5, atol=1e-3, rtol=0)
    assert near_ghost(fused(5, ghost, 4).points(), ghost)  # four have it, and four look through it later
    assert not near_ghost(fused(6, ghost, 4).points(), ghost)


def test_means_are_weighted_by_confidence_and_a_frame_counts_once() -> None:
    both, nothing = FusedCloud(1.0), hall(torch.zeros(3))
    first, second = torch.tensor([[1.2, -0.4, 0.1]]), torch.tensor([[1.6, -0.8, 0.5]])
    nobody = nothing._replace(seen=torch.zeros_like(nothing.seen))
    for _ in range(2):
        both.add("a", cloud(first, 0.9), nobody, torch.zeros(3))
    both.add("b", cloud(second, 0.3), nobody, torch.zeros(3))
    found = both.points()
    torch.testing.assert_close(found.points, (0.9 * first + 0.3 * second) / 1.2)
    torch.testing.assert_close(found.confidence, torch.ones(1))
    both.add("c", cloud(torch.tensor([[1e9, 0.0, 0.0]])), nobody, torch.zeros(3))  # beyond all cubes
    assert len(both) == 1


def test_what_is_written_goes_on_as_if_nothing_had_happened(tmp_path: Path) -> None:
    ghost = torch.tensor([[0.3, 0.1, 0.9]])
    straight = fused(5, ghost, 2)
    path = tmp_path / "fused.npz"
    fused(3, ghost, 2).save(path)
    again = fused(5, ghost, 2, FusedCloud.load(path))
    assert list(again.frames) == list(straight.frames)
    torch.testing.assert_close(again.points(), straight.points(), rtol=0, atol=0)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(FileFormatError, match="a fused cloud; delete it"):
        FusedCloud.load(path)


def test_more_cubes_than_memory_has_room_for_become_larger_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = fused(4, torch.zeros(0, 3), 0)
    monkeypatch.setattr(fusing, "MOST", len(whole) - 1)
    small = fused(4, torch.zeros(0, 3), 0)
    assert (small.side, len(small) < 0.5 * len(whole)) == (0.4, True)
    assert (small.points().points.abs().amax(-1) - HALF).abs().max() < 0.2
    assert set(small._sums[:, fusing.CONFIRMED].tolist()) <= {1.0, 2.0, 3.0, 4.0}


def test_cubes_that_grew_hold_the_means_that_large_ones_have() -> None:
    """Nothing is lost where eight become one, whichever half of it a point is in."""
    generator = torch.Generator().manual_seed(5)
    points = 3 * torch.randn(4000, 3, generator=generator)
    sure = torch.rand(4000, generator=generator)
    ones = torch.ones(GRID.shape)
    clouds = []
    for side in (0.25, 0.5):
        fuse = FusedCloud(side)
        seen = cloud(points)._replace(confidence=sure)
        fuse.add("0", seen, DepthImage(ones, ones, ones > 0), torch.zeros(3))
        clouds.append(fuse)
    clouds[0]._coarsen()
    assert clouds[0].side == 0.5
    torch.testing.assert_close(clouds[0].points(), clouds[1].points(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("column", [0, -1, 40])
def test_what_stands_beside_is_beside_across_the_seam(column: int) -> None:
    """A frame does not look through a point next to something near, wherever the panorama is cut."""
    far, ones = torch.full(GRID.shape, 10.0), torch.ones(GRID.shape)
    row = GRID.shape[0] // 2
    point = 2.0 * GRID.directions[row, column][None]
    near = far.clone()
    near[row, column - 1] = 1.0
    for depth, through in ((far, 1.0), (near, 0.0)):
        fuse = FusedCloud(0.05)
        fuse.add("0", cloud(point), DepthImage(ones, ones, ones > 0), torch.zeros(3))
        fuse.add("1", cloud(-point), DepthImage(depth, ones, ones > 0), torch.zeros(3))
        place = fuse._positions() @ point[0].double() > 0
        assert fuse._sums[place, 11].tolist() == [through]
