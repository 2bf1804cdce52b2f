# SPDX-License-Identifier: Apache-2.0
"""Correlation of the cameras at the points of a sweep, pair by pair.

It is zero-mean normalised cross-correlation (ZNCC). A window is a vertex and its neighbours on the swept sphere, as if
a surface lay there. Tensors are ``(V, planes, N)``, vertices first and hypotheses last: windows gather whole rows, with
all hypotheses, cameras and colours, and operations on a plane run over contiguous memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import torch
from jaxtyping import Bool, Float, Num
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry.directions import in_single_precision
from sphericalvision.icosphere import level_from_num_vertices
from sphericalvision.icosphere.topology import check_level
from sphericalvision.kernels import Operator
from sphericalvision.shapes import check_shapes
from sphericalvision.sweep.ring_mean import ids_of_coarser_level, ring_mean
from sphericalvision.sweep.sphere_sweep import sphere_sweep
from sphericalvision.sweep.sweep_tables import SweepTables
from sphericalvision.sweep.visibility import check_seen

#: Contrast of noise, in the unit of images in [-1, 1]: about one step of 8 bits.
NOISE = 0.01
#: Fraction of the interpolation weights that must be seen for a point to count as seen.
LEAST_SHARE = 0.5


@check_shapes
def correlation_evidence(
    images: Float[Tensor, "B n C V_image"],
    tables: SweepTables,
    seen: Bool[Tensor, "B n V_image"] | Bool[Tensor, "n V_image"] | None = None,
    level: int | None = None,
    noise: float = NOISE,
) -> Float[Tensor, "B 3 N V"]:
    """Return the correlation of the cameras at every point of a sweep, for a network or ``semi_global_sweep``.

    In the window around the point each colour, less its mean, is divided by the contrast of all colours: exposure does
    not matter. The correlation is near 0 where cameras contradict each other or see nothing but ``noise``.

    Args:
        images: ``(B, n, C, V_image)`` of two or more cameras: colours in [-1, 1], or other features.
        tables: of the n cameras, for all of the batch or with a batch dimension B.
        seen: ``([B,] n, V_image)``, True where the images show something; everywhere when not given. A point counts as
            seen if it is in the field of view, and more than half of the interpolation weights there are seen.
        level: of the result, up to that of the tables and their windows; theirs when not given.
        noise: contrast of noise in the unit of the images.

    Returns:
        ``(B, 3, N, V_level)``, differentiable in the images:

        * the mean correlation of the pairs of cameras that see the point, -1 to 1, 0 where there is no pair;
        * the mean of the better half of them, rounded up, each at least 0: a camera whose view is blocked does no harm;
        * the number of cameras that see the point.

    Raises:
        ShapeError: if images, tables and ``seen`` do not fit, or there is one camera only.
        ArgumentError: if the level is above that of the tables.

    References:
        Goesele et al. (2007), "Multi-view stereo for community photo collections", section 6 (view selection); Kang,
        Szeliski and Chai (2001), "Handling occlusions in dense multi-view stereo" (best half).

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.sweep import SphereSweep
        >>> tables = SphereSweep(level=2, num_hypotheses=8, min_depth=0.5, feature_level=4).tables(ring_rig(4))
        >>> images = torch.rand(1, 4, 3, 2562, generator=torch.Generator().manual_seed(0)) * 2 - 1
        >>> mean, best, cameras = correlation_evidence(images, tables)[0]
        >>> mean.shape, bool((best >= mean).all()), cameras[0].unique().tolist()  # at infinity
        (torch.Size([8, 162]), True, [2.0, 3.0, 4.0])
    """
    if images.shape[1] < 2:
        raise ShapeError(
            f"images: expected two or more cameras, (B, n, C, V), got shape {tuple(images.shape)}"
        )
    images = in_single_precision(images)
    batch = images.shape[0]
    table_level = level_from_num_vertices(tables.ids.shape[-3])
    level = table_level if level is None else check_level(level)
    if level > table_level:
        raise ArgumentError(f"level: expected 0 to {table_level}, the level of the tables, got {level}")
    if tables.ids.ndim == 5 and len(tables.ids) != batch:
        raise ShapeError(f"tables: expected those of {batch} rigs or of one for all, got {len(tables.ids)}")
    valid = torch.ones_like(images[:, :, 0]) if seen is None else check_seen(seen, images).to(images)
    return _evidence(images, valid, tables, level, noise)


def _evidence_at_once(images: Tensor, valid: Tensor, tables: SweepTables, level: int, noise: float) -> Tensor:
    """Evidence ``(B, 3, N, V)`` of images ``(B, n, C, V_image)``, valid where ``(B, n, V_image)`` is 1.

    Samples lie side by side as hypotheses do.
    """
    colors, seen = _sweep(images, valid, tables)
    correlations = window_correlations(colors, seen, level, noise)
    seen = _at_level(seen, level)
    pairs = [seen[:, a] * seen[:, b] for a, b in _pairs(seen.shape[1])]
    count = torch.stack(pairs).sum(0)
    mean = torch.stack([c * weight for c, weight in zip(correlations, pairs, strict=True)]).sum(0)
    ranked = [
        c.clamp(0, 1).masked_fill(weight == 0, -1.0) for c, weight in zip(correlations, pairs, strict=True)
    ]
    best = mean_of_better_half(ranked, count)
    evidence = torch.stack((mean / count.clamp(min=1), best, seen.sum(1)))
    return evidence.unflatten(-1, (-1, tables.ids.shape[-4])).permute(2, 0, 3, 1)


def _evidence_by_sample(
    images: Tensor, valid: Tensor, tables: SweepTables, level: int, noise: float
) -> Tensor:
    """One sample after the other, so that its planes stay in the cache of a CPU."""
    if not len(images):
        return NotImplemented
    shared = tables.ids.ndim == 4
    samples = [slice(sample, sample + 1) for sample in range(len(images))]
    rigs = [tables if shared else SweepTables(*(table[sample] for table in tables)) for sample in samples]
    return torch.cat(
        [
            _evidence_at_once(images[sample], valid[sample], rig, level, noise)
            for sample, rig in zip(samples, rigs, strict=True)
        ]
    )


_evidence = Operator(_evidence_at_once, cpu=_evidence_by_sample, fused=_evidence_at_once)


def _sweep(images: Tensor, valid: Tensor, tables: SweepTables) -> tuple[Tensor, Tensor]:
    """Swept colours ``(V, n, C, B N)``, 0 where not seen, and where they are seen ``(V, n, B N)``, 0 or 1.

    Colours are less the mean of the image, which no correlation depends on and which would cost digits. ``valid`` is
    swept with them, and they are divided by it, so that nothing from outside of a view leaks in.

    References:
        Knutsson and Westin (1993), "Normalized and differential convolution".
    """
    valid = valid[:, :, None]
    mean = (images * valid).sum(-1, keepdim=True) / valid.sum(-1, keepdim=True).clamp(min=1)
    values = sphere_sweep(torch.cat(((images - mean) * valid, valid), 2), tables).values
    # (B, n, C + 1, N, V) to vertices first: a window of seven vertices is then seven contiguous rows of all the rest.
    planes = values.permute(4, 1, 2, 0, 3).flatten(3).contiguous()
    share = planes[:, :, -1]
    seen = (share > LEAST_SHARE).to(images.dtype)
    return planes[:, :, :-1] * (seen / share.clamp(min=LEAST_SHARE))[:, :, None], seen


def window_correlations(
    colors: Float[Tensor, "V n C N"], seen: Float[Tensor, "V n N"], level: int, noise: float
) -> list[Float[Tensor, "V_level N"]]:
    """Return the correlation ``(V_level, N)`` of each pair of cameras in the windows around the vertices of a level.

    From each vertex of a window the mean of its own ring is subtracted, not that of the window: squares and products
    are then averaged once, for all cameras and pairs. Where the edge of a view cuts a window, the rest counts; for a
    pair, the rest of the camera that has less.

    Args:
        colors: ``(V, n, C, N)``, 0 where not seen.
        seen: ``(V, n, N)``, 0 or 1.
        level: of the centres of the windows.
        noise: contrast of noise.
    """
    num_cameras = seen.shape[1]
    # Means over what is seen of a window: the ring mean divided by the share that is seen.
    share = ring_mean(seen).clamp(min=1e-6)
    local = (colors - ring_mean(colors) / share[:, :, None]) * seen[:, :, None]
    # Each camera with all later ones at once, in the order of ``_pairs``.
    products = [(local[:, a : a + 1] * local[:, a + 1 :]).sum(2) for a in range(num_cameras - 1)]
    # Squares of each camera and products of each pair, colours summed up: n + n (n - 1) / 2 planes for one gather.
    planes = torch.cat((local.square().sum(2), *products), 1)
    planes = ring_mean(planes, level)
    share = _at_level(share, level)
    variance = planes[:, :num_cameras] / share + noise**2
    scale = variance.clamp(min=1e-20).rsqrt()  # so that 0 stays 0 without noise, too
    return [
        planes[:, num_cameras + pair] / torch.minimum(share[:, a], share[:, b]) * scale[:, a] * scale[:, b]
        for pair, (a, b) in enumerate(_pairs(num_cameras))
    ]


def mean_of_better_half(
    values: Sequence[Float[Tensor, "*places"]], count: Num[Tensor, "*places"]
) -> Float[Tensor, "*places"]:
    """Average the greater half, rounded up, of the first ``count`` of values in descending order; 0 if there are none.

    A sorting network compares whole tensors, which is many times faster than sorting each place for itself.

    References:
        Batcher (1968), "Sorting networks and their applications" (odd-even merge sort).

    Examples:
        >>> low, middle, high = torch.tensor([[0.1], [0.3], [0.7]])
        >>> mean_of_better_half([middle, low, high], torch.tensor([3]))  # two of three
        tensor([0.5000])
    """
    ordered = list(values)
    for a, b in _comparators(len(ordered)):  # the same for all places, however their values lie
        ordered[a], ordered[b] = torch.maximum(ordered[a], ordered[b]), torch.minimum(ordered[a], ordered[b])
    half = (count + 1).div(2, rounding_mode="floor")
    greater = ordered[: (len(ordered) + 1) // 2]
    total = sum(value.masked_fill(half <= rank, 0.0) for rank, value in enumerate(greater))
    return total / half.clamp(min=1)


def _at_level(values: Tensor, level: int) -> Tensor:
    """Values ``(V, *)`` at the vertices of a coarser level, or all of them."""
    own_level = level_from_num_vertices(len(values))
    return values if level == own_level else values[ids_of_coarser_level(own_level, level, values.device)]


def _pairs(num_cameras: int) -> list[tuple[int, int]]:
    return list(combinations(range(num_cameras), 2))


def _comparators(length: int) -> Iterator[tuple[int, int]]:
    """Pairs of positions to compare in turn, which sort any sequence of this length."""
    # Sorted runs of `merged` values are merged in pairs: values `distance` apart are compared, ever closer ones, and
    # never across the border of a pair.
    merged = 1
    while merged < length:
        distance = merged
        while distance >= 1:
            for start in range(distance % merged, length - distance, 2 * distance):
                for place in range(start, min(start + distance, length - distance)):
                    if place // (2 * merged) == (place + distance) // (2 * merged):
                        yield place, place + distance
            distance //= 2
        merged *= 2
