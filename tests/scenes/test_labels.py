# SPDX-License-Identifier: Apache-2.0
"""What rays hit, in rooms that say what their surfaces are."""

import pytest
import torch

from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.scenes import SURFACE_LABELS, MeshScene, make_scene, ray_depth, ray_labels
from sphericalvision.scenes.rendering.primitives import Part, pack


@pytest.fixture(scope="module")
def directions() -> torch.Tensor:
    return icosphere_vertices(4).float()


def test_floors_are_below_and_ceilings_above(directions: torch.Tensor) -> None:
    found = set()
    for seed in range(4):
        scene = make_scene("room", seed)
        labels = ray_labels(scene, torch.zeros(3), directions)
        depth = ray_depth(scene, torch.zeros(3), directions)
        assert torch.equal(labels < 0, depth.isinf())
        assert labels.max() < len(SURFACE_LABELS)
        height = directions[:, 1]
        floor, ceiling, wall = (labels == SURFACE_LABELS.index(n) for n in ("floor", "ceiling", "wall"))
        assert floor[height > 0.95].float().mean() > 0.3
        assert not floor[height < 0].any()
        assert not ceiling[height > 0].any()
        # Floor and ceiling are planes: the rays' ends are all at one height, or, next door, at a second one.
        for plane in (floor, ceiling):
            ends = (depth * height)[plane]
            assert len(ends.mul(100).round().unique()) <= 4
        assert wall.float().mean() > 0.1
        found |= set(labels.unique().tolist())
    named = {SURFACE_LABELS[label] for label in found if label >= 0}
    assert {"floor", "ceiling", "wall", "seat", "storage", "picture", "lamp"} <= named


def test_labels_move_with_the_scene(directions: torch.Tensor) -> None:
    scene, shift = make_scene("room", 2), torch.tensor([0.3, -0.1, 0.2])
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    moved = ray_labels(scene.transformed(turn, shift).scaled(2.0), 2 * shift, directions @ turn.T)
    assert (moved == ray_labels(scene, torch.zeros(3), directions)).float().mean() > 0.999


def test_what_has_no_name_is_other() -> None:
    assert pack([Part("box", (0.0, 0.0, 2.0), (0.5, 0.5, 0.5))]).label.tolist() == [0]
    assert SURFACE_LABELS[0] == "other"
    mesh = MeshScene.__new__(MeshScene)  # a mesh of any content
    with pytest.raises(ArgumentError, match="surfaces of meshes have no names"):
        ray_labels(mesh, torch.zeros(3), torch.tensor([[0.0, 0.0, 1.0]]))  # type: ignore[arg-type]
