# SPDX-License-Identifier: Apache-2.0
"""Lookups against sums written out and against interpolation without tables, in every way they are computed."""

import copy
import pickle
from typing import Any

import pytest
import torch
from torch import Tensor

from sphericalvision.geometry import bilinear_sample
from sphericalvision.geometry.image_lookup import image_lookup, taps_across_edges
from sphericalvision.geometry.lookup import Lookup, weighted_sums
from sphericalvision.geometry.means_by_id import mean_by_id, means_by_id
from sphericalvision.geometry.separable_lookup import SeparableLookup
from sphericalvision.kernels import reference_kernels
from tests.values import rand

DOUBLE = torch.float64
SIZE = (5, 8)


def positions(*shape: int) -> Tensor:
    """Up to half a pixel beyond the outermost centres, where edges matter."""
    return rand(*shape, 2, seed=1) * torch.tensor([SIZE[1], SIZE[0]]) - 0.5


@pytest.mark.parametrize("count", [3, 400])  # less and more than there are values
@pytest.mark.parametrize("batched", [False, True])
def test_weighted_sums_are_sums(count: int, batched: bool) -> None:
    values, shape = rand(2, 3, 50), ((2, count, 4) if batched else (count, 4))
    ids = torch.randint(50, shape, generator=torch.Generator().manual_seed(2))
    weights = rand(*shape, seed=3)
    dense = torch.zeros(*shape[:-1], 50, dtype=DOUBLE).scatter_add_(-1, ids, weights)
    expected = values @ dense.mT
    torch.testing.assert_close(weighted_sums(values, ids, weights), expected)
    with reference_kernels():
        torch.testing.assert_close(weighted_sums(values, ids, weights), expected)
    values.requires_grad_()
    torch.testing.assert_close(weighted_sums(values, ids, weights), expected)
    few = slice(0, 3)
    assert torch.autograd.gradcheck(
        lambda v, w: weighted_sums(v, ids[..., few, :], w),
        (values, weights[..., few, :].clone().requires_grad_()),
        fast_mode=True,
    )


@pytest.mark.parametrize("edges", ["border", "around", "sphere"])
@pytest.mark.parametrize("size", [SIZE, (5, 7)])
def test_images_are_interpolated_across_their_edges(edges: str, size: tuple[int, int]) -> None:
    """As ``bilinear_sample`` does without a table; shared and batched lookups agree, also with sums written out."""
    images = rand(2, 3, *size)
    pixels = rand(40, 2, seed=1) * torch.tensor([size[1], size[0]]) - 0.5
    seen = torch.ones(40, 1, dtype=torch.bool)
    inside = (
        pixels if edges == "sphere" else torch.stack((pixels[:, 0], pixels[:, 1].clamp(0, size[0] - 1)), -1)
    )
    expected = bilinear_sample(images, inside, wrap_longitude=edges != "border")
    shared = image_lookup(pixels[:, None], seen, size, edges=edges)
    torch.testing.assert_close(shared(images), expected)
    batched = image_lookup(pixels.expand(2, 40, 2)[:, :, None], seen.expand(2, 40, 1), size, edges=edges)
    torch.testing.assert_close(batched(images), expected)
    torch.testing.assert_close(
        weighted_sums(images.flatten(-2), *taps_across_edges(pixels, size, edges)), expected
    )


def test_threads_share_the_results_of_one_image(monkeypatch: pytest.MonkeyPatch) -> None:
    images, pixels = rand(3, *SIZE), positions(36, 2)
    lookup = image_lookup(pixels, torch.ones(36, 2, dtype=torch.bool), SIZE, rand(36, 2), "sphere")
    expected = lookup(images)
    chunks, grid_sample = [], torch.nn.functional.grid_sample

    def sampled(images: Tensor, *arguments: Any, **options: Any) -> Tensor:
        chunks.append(len(images))
        return grid_sample(images, *arguments, **options)

    monkeypatch.setattr(torch.nn.functional, "grid_sample", sampled)
    for threads in (4, 1):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        torch.testing.assert_close(lookup(images), expected)
    assert chunks == [6, 1]


@pytest.mark.parametrize("size", [SIZE, (1, 8), (5, 1)])
def test_what_is_not_seen_is_zero_whatever_the_image_holds(size: tuple[int, int]) -> None:
    images = torch.full((1, *size), torch.nan, dtype=DOUBLE)
    pixels = torch.zeros(4, 1, 2, dtype=DOUBLE)
    seen = torch.tensor([[False], [True], [False], [True]])
    found = image_lookup(pixels, seen, size)(images)[0]
    assert found[[0, 2]].tolist() == [0, 0]
    assert found[[1, 3]].isnan().all()
    rows = Lookup(torch.tensor([[0, 1], [1, 0]]), torch.ones(2, 2), seen=torch.tensor([False, True]))
    assert rows(torch.tensor([[torch.inf, 1.0]]))[0].tolist() == [0, torch.inf]
    picked = Lookup(torch.tensor([1, 0]), seen=torch.tensor([False, True]))(torch.tensor([[True, True]]))
    assert picked.dtype == torch.bool
    assert picked[0].tolist() == [False, True]


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_images_in_half_precision_are_looked_up_at_their_places(dtype: torch.dtype) -> None:
    images = rand(3, 40, 900).to(dtype)
    pixels = rand(50, 1, 2, seed=1).float() * torch.tensor([899.0, 39.0])
    lookup = image_lookup(pixels, rand(50, 1, seed=2) > 0.3, (40, 900))
    found, expected = lookup(images), lookup(images.float())
    assert found.dtype == dtype
    torch.testing.assert_close(found, expected.to(dtype))


def test_means_over_places() -> None:
    """Places count by their shares, those not seen as zero."""
    images, pixels = rand(2, *SIZE), positions(6, 3)
    shares, seen = rand(6, 3, seed=4), rand(6, 3, seed=5) > 0.3
    each = bilinear_sample(images, pixels.flatten(0, 1)).view(2, 6, 3) * seen
    torch.testing.assert_close(image_lookup(pixels, seen, SIZE, shares)(images), (each * shares).sum(-1))
    torch.testing.assert_close(image_lookup(pixels, seen, SIZE)(images), each.mean(-1))


@pytest.mark.parametrize("edges", ["border", "around", "sphere"])
@pytest.mark.parametrize(("size", "spacing"), [((12, 24), 1.0), ((11, 23), 0.8), ((12, 25), 1.1)])
def test_a_lattice_is_looked_up_as_its_samples_are(edges: str, size: tuple[int, int], spacing: float) -> None:
    """Across the seam and beyond the poles, with weights of rows and columns; none if one sample is elsewhere."""
    row, column = (torch.arange(length // spacing, dtype=DOUBLE) * spacing for length in size)
    row, column = row[: len(row) // 3 * 3].view(-1, 1, 3, 1), column[: len(column) // 2 * 2].view(-1, 1, 2)
    row, column = row - (0.4 if spacing < 1 else 0), column + (7.6 if edges != "border" else 0)
    pixels = torch.stack(torch.broadcast_tensors(column, row), -1).reshape(-1, 6, 2)
    seen = torch.ones(len(pixels), 6, dtype=torch.bool)
    shares = (rand(*row.shape, seed=2) * rand(*column.shape, seed=3)).reshape(-1, 6)
    images = rand(2, 3, *size).requires_grad_()
    for weights in (None, shares):
        lattice = image_lookup(pixels, seen, size, weights, edges)
        samples = image_lookup(pixels.clone().requires_grad_(), seen, size, weights, edges)
        assert isinstance(lattice, SeparableLookup)
        assert not isinstance(samples, SeparableLookup)
        torch.testing.assert_close(lattice(images), samples(images), rtol=0, atol=1e-12)
        slopes = [torch.autograd.grad(look(images).square().sum(), images)[0] for look in (lattice, samples)]
        torch.testing.assert_close(*slopes, rtol=0, atol=1e-11)
        half = lattice.float()(images.half())
        assert half.dtype == torch.float16
        torch.testing.assert_close(half.double(), samples(images.half().double()), rtol=0, atol=1e-3)
    for changed in (pixels, shares, seen):
        other = changed.clone()
        other[3, 1] = 0
        arguments = (other if changed is each else each for each in (pixels, seen, shares))
        moved, at, weights = arguments
        assert not isinstance(image_lookup(moved, at, size, weights, edges), SeparableLookup)


def test_gradients() -> None:
    images, pixels = rand(1, *SIZE).requires_grad_(), positions(4, 1).requires_grad_()
    seen = torch.tensor([[True], [True], [False], [True]])

    def look(images: Tensor, pixels: Tensor) -> Tensor:
        return image_lookup(pixels, seen, SIZE, edges="sphere")(images)

    assert torch.autograd.gradcheck(look, (images, pixels))


def test_tables_are_copied_and_moved_and_not_saved() -> None:
    lookup = image_lookup(positions(4, 1), torch.ones(4, 1, dtype=torch.bool), SIZE, edges="around")
    images = rand(1, *SIZE)
    for other in (copy.deepcopy(lookup), pickle.loads(pickle.dumps(lookup))):
        assert torch.equal(other(images), lookup(images))
    assert lookup.state_dict() == {}
    assert lookup.to("meta")(images.to("meta")).shape == (1, 4)


def test_mean_is_the_sum_over_the_count() -> None:
    generator = torch.Generator().manual_seed(0)
    ids = torch.cat((torch.arange(40), torch.randint(40, (300,), generator=generator)))
    values = torch.randn(2, 3, len(ids), generator=generator, dtype=torch.float64)
    tables = means_by_id(ids, 40)
    assert len(tables.others) > 0  # ids with more places than most
    expected = values.new_zeros(2, 3, 40).index_add(-1, ids, values) / ids.bincount()
    torch.testing.assert_close(mean_by_id(values, tables), expected)
    even = means_by_id(torch.arange(40).repeat(3), 40)
    assert len(even.others) == 0
    torch.testing.assert_close(
        mean_by_id(values[..., :120], even), values[..., :120].unflatten(-1, (3, 40)).mean(-2)
    )
