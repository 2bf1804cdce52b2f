# SPDX-License-Identifier: Apache-2.0
"""Tangent images: patches are perspective images, faces share them out, solid angles are cut by the faces."""

import math

import pytest
import torch

from sphericalvision.icosphere import icosphere_faces, icosphere_vertices
from sphericalvision.sphere import TangentImages
from tests.laws.grid_laws import DOUBLE, spread_directions


def test_convention_tangent_patches() -> None:
    """Patches touch the sphere at the middle of each face, columns grow to the right, rows down."""
    grid = TangentImages(1, 9, dtype=DOUBLE)
    corners = icosphere_vertices(1, DOUBLE)[icosphere_faces(1)]
    middle = torch.nn.functional.normalize(corners.sum(1), dim=-1)
    torch.testing.assert_close(grid.directions[:, 4, 4], middle)
    right = grid.directions[:, 4, 5] - grid.directions[:, 4, 4]
    down = grid.directions[:, 5, 4] - grid.directions[:, 4, 4]
    assert (grid.world_from_patch[:, 1, 0].abs() < 1e-12).all()  # level
    assert (down[:, 1] > 0).all()
    assert ((torch.linalg.cross(right, down) * middle).sum(-1) > 0).all()


def test_patches_are_images_of_the_camera() -> None:
    grid = TangentImages(0, 7, margin=1, dtype=DOUBLE)
    rays = grid.camera.unproject(grid.camera.pixel_grid(DOUBLE)).directions
    for patch, world_from_patch in enumerate(grid.world_from_patch):
        torch.testing.assert_close(rays @ world_from_patch.T, grid.directions[patch])


@pytest.mark.parametrize(("level", "size", "margin"), [(0, 8, 0.0), (0, 9, 1.0), (1, 6, 0.5)])
def test_faces_fit_into_their_patches(level: int, size: int, margin: float) -> None:
    """All directions are read inside of the patch, a margin away from its outermost pixel centres."""
    grid = TangentImages(level, size, margin, dtype=DOUBLE)
    patch, pixels = grid.face_coordinates(spread_directions(20_000))
    assert torch.equal(patch.unique(), torch.arange(grid.num_patches))
    assert margin - 1e-9 <= pixels.min() < margin + 0.5
    assert size - 1.5 - margin < pixels.max() <= size - 1 - margin + 1e-9


def test_solid_angles_of_the_pixels_of_a_face_sum_to_the_face() -> None:
    """The oracle: the spherical excess of each face, by the angles at its corners."""
    grid = TangentImages(1, 7, dtype=DOUBLE)
    a, b, c = icosphere_vertices(1, DOUBLE)[icosphere_faces(1)].unbind(1)

    def angle(at: torch.Tensor, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        p, q = torch.linalg.cross(at, left), torch.linalg.cross(at, right)
        return torch.acos((p * q).sum(-1) / (p.norm(dim=-1) * q.norm(dim=-1)))

    excess = angle(a, b, c) + angle(b, c, a) + angle(c, a, b) - math.pi
    torch.testing.assert_close(grid.solid_angles.sum((1, 2)), excess, rtol=1e-10, atol=0)
    assert (grid.solid_angles <= grid.cell_widths**2 * 1.02).all()
    assert (grid.solid_angles == 0).any()
