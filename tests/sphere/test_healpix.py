# SPDX-License-Identifier: Apache-2.0
"""HEALPix against healpy where it is installed, and always against the formulas, literals and counts."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.geometry import longitude_latitude_from_directions
from sphericalvision.sphere import Healpix, healpix_pool, healpix_upsample, nested_from_ring, ring_from_nested
from sphericalvision.sphere.grids.healpix_pixels import direction_of_place, place_from_ring
from tests.laws.grid_laws import DOUBLE, spread_directions


def gorski_centers(nside: int) -> list[tuple[float, float]]:
    """(z, φ) of every pixel in ring order: equations 4, 5, 8 and 9 of Górski et al. (2005), and their mirror images."""
    centers = []
    for ring in range(1, 4 * nside):
        mirrored = min(ring, 4 * nside - ring)
        if mirrored < nside:
            z = 1 - mirrored**2 / (3 * nside**2)
            row = [(math.pi / (2 * mirrored)) * (j - 0.5) for j in range(1, 4 * mirrored + 1)]
        else:
            z = 4 / 3 - 2 * mirrored / (3 * nside)
            s = (
                ring - nside + 1
            ) % 2 or 2  # every pixel of a ring; the first one that healpy counts is at φ = 0
            row = [(math.pi / (2 * nside)) * (j - s / 2) for j in range(1, 4 * nside + 1)]
        centers += [(z if ring <= 2 * nside else -z, phi) for phi in row]
    return centers


def angles(directions: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """healpy's θ and φ of directions."""
    longitude, latitude = longitude_latitude_from_directions(directions)
    return (math.pi / 2 - latitude).numpy(), longitude.numpy() % (2 * math.pi)


def awkward_directions() -> Tensor:
    """All over the sphere, and densely around both poles."""
    near = spread_directions(4000) * torch.tensor([0.02, 1.0, 0.02], dtype=DOUBLE)
    return torch.cat((spread_directions(20_000), near / near.norm(dim=-1, keepdim=True)))


@pytest.mark.parametrize("nside", [1, 2, 3, 8, 13])
def test_centers_are_those_of_the_paper(nside: int) -> None:
    expected = gorski_centers(nside)
    z, phi = torch.tensor(expected, dtype=DOUBLE).unbind(-1)
    radius = (1 - z * z).sqrt()
    torch.testing.assert_close(
        Healpix(nside, dtype=DOUBLE).directions, torch.stack((radius * phi.sin(), -z, radius * phi.cos()), -1)
    )


@pytest.mark.parametrize("nside", [1, 2, 4, 16])
def test_nested_pixels_contain_their_children(nside: int) -> None:
    directions = awkward_directions()
    fine, coarse = Healpix(2 * nside, nested=True), Healpix(nside, nested=True)
    assert torch.equal(fine.nearest(directions) // 4, coarse.nearest(directions))
    children = fine.directions.view(-1, 4, 3).double().mean(1)
    assert torch.equal(coarse.nearest(children), torch.arange(coarse.num_pixels))


@pytest.mark.parametrize("nside", [1, 2, 4, 32])
def test_ring_and_nested_name_the_same_pixels(nside: int) -> None:
    ids = torch.arange(12 * nside**2)
    ring, nested = Healpix(nside, dtype=DOUBLE), Healpix(nside, nested=True, dtype=DOUBLE)
    torch.testing.assert_close(ring.directions, nested.directions[nested_from_ring(ids, nside)])
    assert torch.equal(ring_from_nested(nested_from_ring(ids, nside), nside), ids)
    assert torch.equal(nested_from_ring(ids, nside).sort().values, ids)
    for renumbered in (ring_from_nested, nested_from_ring):
        neighbors = renumbered(ring.neighbors, nside)
        assert torch.equal(neighbors < 0, ring.neighbors < 0)
        assert renumbered(torch.tensor([-1, 0]), nside)[0] == -1
        for nowhere in (-2, 12 * nside**2):
            with pytest.raises(ArgumentError, match=r"ids: .* -1 for none"):
                renumbered(torch.tensor([nowhere]), nside)


def test_convention_healpix_numbers_are_healpys() -> None:
    """Made by healpy 1.20.1, e.g. ``healpy.get_interp_weights(4, 1.0, 2.0)`` and ``healpy.ang2pix(4, 1.0, 2.0)``."""
    theta = torch.tensor([1.0, 0.1, 3.0], dtype=DOUBLE)
    phi = torch.tensor([2.0, 3.0, 0.5], dtype=DOUBLE)
    directions = torch.stack((theta.sin() * phi.sin(), -theta.cos(), theta.sin() * phi.cos()), -1)
    grid = Healpix(4)
    assert grid.nearest(directions).tolist() == [45, 1, 188]
    assert Healpix(4, nested=True).nearest(directions).tolist() == [24, 31, 128]
    ids, weights = grid.locate(directions[:2])
    assert ids[0].tolist() == [28, 29, 45, 46]
    expected = torch.tensor([0.0932008, 0.13577027, 0.69935548, 0.07167344], dtype=DOUBLE)
    torch.testing.assert_close(weights[0], expected, rtol=0, atol=1e-8)
    by_pixel = dict(zip(ids[1].tolist(), weights[1].tolist(), strict=True))
    at_the_pole = {3: 0.12773877, 0: 0.12773877, 1: 0.41634407, 2: 0.32817838}
    assert by_pixel == pytest.approx(at_the_pole, abs=1e-8)


INTEGERS = [torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64]


@pytest.mark.parametrize("dtype", INTEGERS)
@pytest.mark.parametrize("renumbered", [ring_from_nested, nested_from_ring])
def test_numbers_may_be_integers_of_every_type(
    renumbered: Callable[[Tensor, int], Tensor], dtype: torch.dtype
) -> None:
    """The largest number that a type holds is a pixel like any other, and those between are in int64."""
    for nside in (1, 4, 64, 2**14):
        largest = min(torch.iinfo(dtype).max, 12 * nside**2 - 1)
        ids = torch.tensor([0, 1, largest // 3, largest], dtype=dtype)
        expected = renumbered(ids.long(), nside)
        assert expected.dtype == torch.int64
        assert torch.equal(renumbered(ids, nside), expected)
        other = nested_from_ring if renumbered is ring_from_nested else ring_from_nested
        assert torch.equal(other(expected, nside), ids.long())
    if dtype.is_signed:
        assert renumbered(torch.tensor([-1], dtype=dtype), 4).tolist() == [-1]


@pytest.mark.parametrize("nside", [1, 2, 3, 8, 64])
@pytest.mark.parametrize("nested", [False, True])
def test_agrees_with_healpy(nside: int, nested: bool) -> None:
    healpy = pytest.importorskip("healpy", reason="healpy is in the extra 'dev'")
    if nested and nside & (nside - 1):
        pytest.skip("the nested order needs a power of two")
    grid = Healpix(nside, nested, dtype=DOUBLE)
    x, y, z = healpy.pix2vec(nside, np.arange(grid.num_pixels), nest=nested)
    torch.testing.assert_close(grid.directions, torch.from_numpy(np.stack((y, -z, x), -1)))
    directions = awkward_directions()
    theta, phi = angles(directions)
    assert np.array_equal(grid.nearest(directions).numpy(), healpy.ang2pix(nside, theta, phi, nest=nested))
    their_ids, their_weights = healpy.get_interp_weights(nside, theta, phi, nest=nested)
    ids, _ = grid.locate(directions)
    same = (np.sort(ids.numpy(), -1) == np.sort(their_ids.T, -1)).all(-1)
    assert same.mean() > 0.999  # on a border the pixel without weight may be either
    values = torch.randn(1, grid.num_pixels, dtype=DOUBLE)
    theirs = (values.numpy()[0][their_ids] * their_weights).sum(0)
    torch.testing.assert_close(
        grid.sample(values, directions)[0], torch.from_numpy(theirs), rtol=0, atol=1e-11
    )
    if not nested and nside & (nside - 1) == 0:
        ring = np.arange(grid.num_pixels)
        assert np.array_equal(
            nested_from_ring(torch.from_numpy(ring), nside).numpy(), healpy.ring2nest(nside, ring)
        )


@pytest.mark.parametrize("nside", [1, 2, 5, 16])
def test_interpolation_between_chords(nside: int) -> None:
    """A partition of unity of non-negative weights, continuous, exact at the centres, second order at the poles."""
    grid = Healpix(nside, dtype=DOUBLE)
    directions = awkward_directions()
    ids, weights = grid.taps(directions)
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(directions), dtype=DOUBLE))
    assert weights.min() > -1e-12
    values = torch.randn(grid.num_pixels, dtype=DOUBLE)
    nearby_ids, nearby_weights = grid.taps(directions + 1e-9 * torch.randn_like(directions))
    step = (values[ids] * weights).sum(-1) - (values[nearby_ids] * nearby_weights).sum(-1)
    assert step.abs().max() < 1e-6
    own_ids, own_weights = grid.taps(grid.directions)
    torch.testing.assert_close((values[own_ids] * own_weights).sum(-1), values, rtol=0, atol=1e-12)


def test_healpys_interpolation_is_of_first_order_at_the_poles_and_chords_are_not() -> None:
    """Why ``resample`` does not use healpy's weights: x along the polar ring comes out shorter than it is."""
    errors: dict[str, list[float]] = {"healpy": [], "chords": []}
    for nside in (16, 32):
        grid = Healpix(nside, dtype=DOUBLE)
        theta = math.sqrt(2 / 3) / nside  # the first ring
        phi = torch.linspace(0, 2 * math.pi, 101, dtype=DOUBLE)
        directions = torch.stack(
            (theta * phi.sin(), torch.full_like(phi, -math.cos(theta)), theta * phi.cos()), -1
        )
        for interpolation, found in errors.items():
            ids, weights = grid.locate(directions, interpolation)
            found.append(
                (grid.directions[ids] * weights[..., None]).sum(1).sub(directions).abs().max().item()
            )
    assert 1.8 < errors["healpy"][0] / errors["healpy"][1] < 2.2
    assert errors["chords"][0] / errors["chords"][1] > 3.5


@pytest.mark.parametrize(
    ("nside", "nested"), [(1, False), (2, True), (2, False), (3, False), (8, True), (8, False)]
)
def test_neighbors_are_healpys(nside: int, nested: bool) -> None:
    healpy = pytest.importorskip("healpy")
    expected = healpy.get_all_neighbours(nside, np.arange(12 * nside**2), nest=nested).T
    np.testing.assert_array_equal(Healpix(nside, nested).neighbors.numpy(), expected)


@pytest.mark.parametrize("nside", [2, 5])
def test_neighbors_touch(nside: int) -> None:
    """They share a corner: each pixel's are those that lie around its four corners; and they are each other's."""
    grid = Healpix(nside, dtype=DOUBLE)
    face, column, row = (part[:, None] for part in place_from_ring(torch.arange(grid.num_pixels), nside))
    x, y = torch.tensor([0, 0, 1, 1]), torch.tensor([0, 1, 0, 1])
    corners = (
        direction_of_place(face.expand(-1, 4), (column + x) / nside, (row + y) / nside)
        .flatten(0, 1)
        .to(DOUBLE)
    )
    near = corners @ corners.T > math.cos(1e-3)
    touching = near.view(grid.num_pixels, 4, grid.num_pixels, 4).any(-1).any(1).fill_diagonal_(False)
    found = torch.zeros_like(touching)
    pixel, which = (grid.neighbors >= 0).nonzero(as_tuple=True)
    found[pixel, grid.neighbors[pixel, which]] = True
    assert torch.equal(found, touching)
    assert len(pixel) == 8 * grid.num_pixels - 24


@pytest.mark.parametrize("nested", [False, True])
def test_a_pyramid_is_healpys_and_keeps_the_integral(nested: bool) -> None:
    values = torch.rand(2, 12 * 64, dtype=DOUBLE, generator=torch.Generator().manual_seed(3))
    coarse = healpix_pool(values, nested=nested)
    torch.testing.assert_close(coarse.mean(-1), values.mean(-1))
    assert torch.equal(healpix_pool(healpix_upsample(coarse, nested), "max", nested), coarse)
    # The pixel that holds each of the finer ones
    there = Healpix(4, nested).nearest(Healpix(8, nested).directions)
    assert torch.equal(healpix_upsample(coarse, nested), coarse[:, there])
    healpy = pytest.importorskip("healpy")
    order = "NESTED" if nested else "RING"
    expected = [healpy.ud_grade(row, 4, order_in=order, order_out=order) for row in values.numpy()]
    np.testing.assert_allclose(coarse.numpy(), expected, rtol=1e-14)
