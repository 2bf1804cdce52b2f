# SPDX-License-Identifier: Apache-2.0
"""Laws that every grid obeys, and resampling between every two of them."""

import inspect
import math

import pytest
import torch
from torch import Tensor

from sphericalvision import sphere
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere import Healpix, SphereGrid, resample, resample_mask
from sphericalvision.sphere.resampling.supersampling import cell_samples
from tests.laws.grid_laws import DOUBLE, GRIDS, some_rotation, spread_directions
from tests.laws.harmonics import harmonics

NAMES = list(GRIDS)
WHOLE = [name for name, entry in GRIDS.items() if entry.share == 1]
PAIRS = [(a, b) for a in NAMES for b in NAMES]


def make(name: str, scale: int = 1) -> SphereGrid:
    return GRIDS[name].make(scale)


def test_every_grid_of_the_package_has_an_entry() -> None:
    offered = {kind for kind in vars(sphere).values() if inspect.isclass(kind) and hasattr(kind, "nearest")}
    assert offered - {SphereGrid} | {Icosphere} == {type(make(name)) for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
def test_contract(name: str) -> None:
    grid = make(name, 1)
    assert isinstance(grid, SphereGrid)
    assert grid.directions.shape == (*grid.shape, 3)
    assert grid.solid_angles.shape == tuple(grid.shape)
    assert grid.solid_angles.sum().item() == pytest.approx(4 * math.pi * GRIDS[name].share, rel=1e-12)
    assert (grid.solid_angles >= 0).all()
    torch.testing.assert_close(grid.directions.norm(dim=-1), torch.ones(grid.shape, dtype=DOUBLE))
    assert grid.state_dict() == {}
    values = torch.ones(1, *(size + 1 for size in grid.shape))
    wrong = {"image": values, "padded": values}
    wrong |= dict.fromkeys(("contains", "face_coordinates", "locate", "nearest"), torch.ones(5, 2))
    for method in wrong.keys() & {*dir(grid)}:
        with pytest.raises(ShapeError, match=r"^(values|directions): "):
            getattr(grid, method)(wrong[method])


@pytest.mark.parametrize("name", NAMES)
def test_cells_of_the_nearest_value_have_the_stated_solid_angles(name: str) -> None:
    """Counting points of equal area in the cells of ``nearest`` gives ``solid_angles``."""
    grid = make(name, 1)
    points = 200 * math.prod(grid.shape)
    directions = spread_directions(points)
    if GRIDS[name].share < 1:
        directions = directions[grid.contains(directions)]  # type: ignore[attr-defined]
    counts = torch.bincount(grid.nearest(directions), minlength=math.prod(grid.shape))
    measured = counts.view(grid.shape) * (4 * math.pi / points)
    difference = (measured - grid.solid_angles).abs() / grid.solid_angles.mean()
    assert difference.max() < GRIDS[name].cells


@pytest.mark.parametrize("name", [name for name in NAMES if name != "tangent"])  # whose cells overlap
def test_samples_of_a_cell_lie_in_it(name: str) -> None:
    """But for the corners of cells whose neighbours are not all as near."""
    grid = make(name, 1)
    samples = cell_samples(grid, 4, DOUBLE, torch.device("cpu"))
    own = torch.arange(math.prod(grid.shape))[:, None]
    inside = (grid.nearest(samples.directions) == own) * samples.shares
    torch.testing.assert_close(samples.shares.sum(-1).expand(len(own)), torch.ones(len(own), dtype=DOUBLE))
    assert inside.sum(-1).min() > 0.85


@pytest.mark.parametrize("count", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", NAMES)
def test_interpolation_is_convex(name: str, count: int) -> None:
    """No result is beyond the values, on the values' own directions and between two of them neither."""
    grid = make(name, 16).to(torch.float32)  # type: ignore[attr-defined]
    own = grid.directions.reshape(-1, 3)
    directions = torch.cat((spread_directions(count).float(), own, own[1:] + own[:-1], own + own.roll(7, 0)))
    values = torch.randint(2, (1, *grid.shape), generator=torch.Generator().manual_seed(0)).float()
    for found in (grid.sample(values, directions), 1 - grid.sample(1 - values, directions)):
        assert found[found.isfinite()].min() >= -1e-6
        assert found[found.isfinite()].max() <= 1 + 1e-6
    assert grid.sample(values, directions).nan_to_num().min() >= 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", [torch.float32, DOUBLE])
@pytest.mark.parametrize("name", NAMES)
def test_what_is_not_finite_is_nan_or_refused(name: str, kind: torch.dtype, value: float) -> None:
    grid = make(name).to(kind)  # type: ignore[attr-defined]
    bad = torch.eye(3, dtype=kind).masked_fill(torch.eye(3, dtype=torch.bool), value)
    directions = torch.cat((bad + grid.directions.reshape(-1, 3)[:3], grid.directions.reshape(-1, 3)[3:5]))
    found = grid.sample(torch.ones(2, *grid.shape, dtype=kind), directions)
    assert found.isnan().tolist() == [[True] * 3 + [False] * 2] * 2
    if hasattr(grid, "locate"):
        ids, weights = grid.locate(directions)
        assert weights.isnan().all(-1).tolist() == [True] * 3 + [False] * 2
        assert ids.min() >= 0
        assert ids.max() < math.prod(grid.shape)
    for wrong in (directions, directions[3:] / 0.0):
        with pytest.raises(ArgumentError, match=r"directions: .* NaN"):
            grid.nearest(wrong)
    if hasattr(grid, "contains"):
        assert not grid.contains(directions[:3]).any()


@pytest.mark.parametrize("kind", [torch.float32, DOUBLE])
@pytest.mark.parametrize("name", NAMES)
def test_length_does_not_matter(name: str, kind: torch.dtype) -> None:
    """Directions may have any length that a number can."""
    grid = make(name).to(kind)  # type: ignore[attr-defined]
    directions = spread_directions(500).to(kind)
    values = torch.rand(1, *grid.shape, generator=torch.Generator().manual_seed(0)).to(kind)
    expected, nearest = grid.sample(values, directions), grid.nearest(directions)
    limits = torch.finfo(kind)
    for length in (4 * limits.tiny, 1e-30, 1e-20, 1e-13, 1e-9, 1e-5, 1e4, 1e10, 1e19, 1e30, limits.max / 4):
        scaled = directions * length
        found = grid.sample(values, scaled)
        # To about the twentieth of a cell: close to a pole the last digit of a component turns the longitude.
        torch.testing.assert_close(found, expected, rtol=0, atol=0.05, equal_nan=True)
        assert (found - expected).abs().nanmean() < 1e-4
        assert (grid.nearest(scaled) == nearest).float().mean() > 0.99


@pytest.mark.parametrize("mode", ["bilinear", "nearest", "area"])
@pytest.mark.parametrize("name", NAMES)
def test_onto_itself_is_the_identity(name: str, mode: str) -> None:
    grid = make(name, 1)
    values = torch.randn(2, 3, *grid.shape, dtype=DOUBLE)
    assert torch.equal(resample(values, grid, grid, mode=mode), values)
    around = resample(values, grid, grid, torch.eye(3, dtype=DOUBLE), mode=mode)
    mine = GRIDS[name].owned(grid)
    torch.testing.assert_close(around[..., mine], values[..., mine], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("source", "target"), PAIRS)
def test_constants_stay_constant(source: str, target: str) -> None:
    a, b = make(source, 2), make(target, 1)
    for mode in ("bilinear", "area", "nearest"):
        values = resample(
            torch.full((1, *a.shape), 3.5, dtype=DOUBLE), a, b, some_rotation(), mode, fill=-1.0
        )
        valid = resample_mask(a, b, some_rotation(), mode)
        expected = torch.where(valid, 3.5, -1.0).double()[None]
        torch.testing.assert_close(values, expected, rtol=0, atol=1e-13)
        assert valid.all() or GRIDS[source].share < 1
        assert valid.any()


def test_harmonics_are_orthonormal() -> None:
    """The functions of these tests are what they are said to be."""
    grid = make("equirectangular", 4)
    values = harmonics(grid.directions).flatten(1)
    gram = values * grid.solid_angles.flatten() @ values.T
    torch.testing.assert_close(gram, torch.eye(16, dtype=DOUBLE), rtol=0, atol=5e-3)


@pytest.mark.parametrize("name", NAMES)
def test_seam_and_poles_are_no_worse_than_the_inside(name: str) -> None:
    """Functions of degree three or less, from each grid: the largest error is not at the awkward places."""
    grid = make(name, 4)
    directions = spread_directions(40_000)
    directions = directions[GRIDS[name].inside(grid, directions)]
    rotation = some_rotation(3)
    values = harmonics(grid.directions)
    if isinstance(grid, Healpix):  # whose sample keeps the numbers of healpy
        ids, weights = grid.taps(directions)
        sampled = (values[:, ids] * weights).sum(-1)
    else:
        sampled = grid.sample(values, directions)
    error = (sampled - harmonics(directions)).abs().amax(0)
    places = GRIDS[name].awkward(grid, directions)
    inside = ~torch.stack(list(places.values())).any(0)
    assert inside.sum() > 5000
    for place, there in places.items():
        assert there.sum() > 20, place
        assert error[there].max() < 1.1 * error[inside].max(), place
    target = make("icosphere", 2)
    towards = target.directions @ rotation
    wrong = (resample(values, grid, target, rotation) - harmonics(towards)).abs()
    assert wrong[:, GRIDS[name].inside(grid, towards)].max() < 1.1 * error.max()


@pytest.mark.parametrize("name", NAMES)
def test_symmetric_rotations_permute(name: str) -> None:
    """A rotation that maps the grid onto itself moves values, and changes none."""
    grid = make(name, 1)
    values = torch.randn(1, *grid.shape, dtype=DOUBLE)
    mine = GRIDS[name].owned(grid)
    for rotation in GRIDS[name].symmetries(grid):
        came_from = grid.nearest((grid.directions @ rotation).reshape(-1, 3))
        assert len(came_from[mine.flatten()].unique()) == mine.sum()
        expected = values.flatten(1)[:, came_from].view_as(values)
        turned = resample(values, grid, grid, rotation)
        torch.testing.assert_close(turned[:, mine], expected[:, mine], rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["cubemap", "equirectangular", "icosphere", "healpix"])
def test_symmetric_rotations_commute(name: str) -> None:
    """To rotate and then convert is to convert and then rotate, for a rotation that both grids know."""
    source, target = make(name, 1), make(name, 2)
    values = torch.randn(1, *source.shape, dtype=DOUBLE)
    for rotation in GRIDS[name].symmetries(source)[:8]:
        first = resample(resample(values, source, source, rotation), source, target)
        last = resample(resample(values, source, target), target, target, rotation)
        torch.testing.assert_close(first, last, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("source", "target"),
    [("equirectangular", "cubemap"), ("cubemap", "healpix"), ("nested", "icosphere"), ("icosphere", "tangent"),
     ("tangent", "equirectangular")],
)  # fmt: skip
def test_there_and_back_converges_quadratically(source: str, target: str) -> None:
    """A -> B -> A of linear interpolation: half the distance between values, a quarter of the error."""
    rotation = some_rotation(1)
    errors = []
    for scale in (2, 4):
        a, b = make(source, scale), make(target, scale)
        values = harmonics(a.directions)
        back = resample(resample(values, a, b, rotation), b, a, rotation.T)
        errors.append((back - values).square().mean().sqrt())
    assert 3.2 < errors[0] / errors[1] < 5.5


@pytest.mark.parametrize(
    ("source", "target"), [(a, b) for a in WHOLE for b in WHOLE if "nested" not in (a, b)]
)
def test_area_averages_over_the_cells(source: str, target: str) -> None:
    """Shrinking noise keeps its mean, better than noise itself tells its mean, and takes away its variance."""
    a, b = make(source, 4), make(target, 1)
    noise = torch.randn(4, *a.shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(0)) + 1
    small = resample(noise, a, b, some_rotation(2), mode="area")

    def mean(values: Tensor, grid: SphereGrid) -> Tensor:
        return (values * grid.solid_angles).flatten(1).sum(-1) / (4 * math.pi)

    standard_error = (a.solid_angles / (4 * math.pi)).square().sum().sqrt()
    assert (mean(small, b) - mean(noise, a)).abs().max() < 0.7 * standard_error
    aliased = resample(noise, a, b, some_rotation(2))
    assert small.var() < 0.5 * aliased.var()


@pytest.mark.parametrize("name", NAMES)
def test_labels_are_those_of_the_nearest_value(name: str) -> None:
    grid, target = make(name, 1), make("icosphere", 1)
    labels = torch.randint(100, 200, (2, 1, *grid.shape))
    found = resample(labels, grid, target, some_rotation(), mode="nearest")
    assert found.dtype == torch.int64
    at = grid.nearest(target.directions @ some_rotation())
    seen = resample_mask(grid, target, some_rotation(), mode="nearest")
    assert torch.equal(found[..., seen], labels.flatten(2)[..., at[seen]])
    assert resample(labels.bool(), grid, target, mode="nearest").dtype == torch.bool
    # The value nearest by angle is the one found, but where cells are no Voronoi cells: close to their borders.
    angles = target.directions @ some_rotation() @ grid.directions.reshape(-1, 3).T
    assert (angles.gather(1, at[:, None])[:, 0] > angles.amax(1) - 0.05)[seen].all()


@pytest.mark.parametrize("name", NAMES)
def test_gradients(name: str) -> None:
    grid = make(name)
    target = Icosphere(0, dtype=DOUBLE)
    values = torch.rand(1, *grid.shape, dtype=DOUBLE, requires_grad=True)
    rotation = some_rotation(4).requires_grad_()
    for mode in ("bilinear", "area"):
        assert torch.autograd.gradcheck(
            lambda v, r, mode=mode: resample(v, grid, target, r, mode), (values, rotation), fast_mode=True
        )


@pytest.mark.parametrize("name", NAMES)
def test_a_rotation_for_each_of_a_batch(name: str) -> None:
    grid, target = make(name, 1), make("cubemap", 1)
    values = torch.rand(2, 3, *grid.shape, dtype=DOUBLE)
    rotations = torch.stack((some_rotation(0), some_rotation(1)))
    for mode in ("bilinear", "nearest", "area"):
        together = resample(values, grid, target, rotations, mode)
        alone = [resample(v, grid, target, r, mode) for v, r in zip(values, rotations, strict=True)]
        torch.testing.assert_close(together, torch.stack(alone), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_directions_in_half_precision_are_where_they_say(name: str, kind: torch.dtype) -> None:
    """What is computed of them is computed in float32, as a thousand pixels want it."""
    grid = make(name, 2)
    directions = torch.randn(200, 3, generator=torch.Generator().manual_seed(0)).to(kind)
    values = torch.rand(3, *grid.shape, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(
        grid.sample(values, directions), grid.sample(values, directions.float()), rtol=0, atol=0
    )
    assert torch.equal(grid.nearest(directions), grid.nearest(directions.float()))
