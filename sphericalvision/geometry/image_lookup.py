# SPDX-License-Identifier: Apache-2.0
"""Lookups by position: each of P results is a mean over m positions in an image, interpolated between pixels.

``image_lookup`` returns a ``SeparableLookup`` where samples lie on a lattice. Otherwise it chooses one of three modules
by what continues an image beyond its outermost pixel centres:

* ``ImageLookup`` repeats them. ``grid_sample`` finds pixels and weights faster than a table of them is read.
* ``SeamLookup`` reads the few positions whose kernel leaves the image entry by entry, across the edges of a panorama.
* ``PaddedLookup`` has a batch of lookups, some of which leave the image at nearly every position: it pads the panorama.

All map images ``(*b, C, h, w)`` to ``(*b, C, P)``, give zero where nothing is seen, and are differentiable in images
and positions. Their tables move with ``.to`` and are not saved.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sphericalvision.geometry.bilinear import wrap_panorama
from sphericalvision.geometry.directions import broadcast_shapes, components, from_components
from sphericalvision.geometry.lookup import PlacesInSinglePrecision, weighted_sums
from sphericalvision.geometry.separable_lookup import SeparableLookup, find_lattice
from sphericalvision.kernels import Operator

_OUTSIDE = -9.0  # normalised coordinates so far out that grid_sample reads zeros there
_MAX_CHUNKS = 8  # of the results of one image, for different threads


def image_lookup(
    pixels: Float[Tensor, "*#g P m 2"],
    seen: Bool[Tensor, "*#g P m"],
    image_size: tuple[int, int],
    shares: Float[Tensor, "*#g P m"] | None = None,
    edges: str = "border",
    cubic: bool = False,
) -> ImageLookup | SeparableLookup:
    """Return the lookup of means over m positions each in an image.

    Args:
        pixels: ``(*g, P, m, 2)`` as (u, v), pixel centres at integers.
        seen: ``(*g, P, m)``; positions that are not seen count as zero.
        image_size: (height, width).
        shares: ``(*g, P, m)``, weights of the m positions in their result; all the same if not given.
        edges: what continues an image beyond its outermost centres: ``"border"``, these pixels again; ``"around"``,
            left and right edges meet; ``"sphere"``, these, and beyond the poles the opposite side.
        cubic: whether to interpolate with the bicubic kernel in place of the bilinear one.

    Examples:
        >>> pixels, seen = torch.tensor([[[0.5, 0.0]], [[9.0, 0.0]]]), torch.tensor([[True], [False]])
        >>> image_lookup(pixels, seen, (1, 4))(torch.tensor([[[2.0, 4.0, 6.0, 8.0]]]))
        tensor([[3., 0.]])
    """
    height, width = image_size
    u, v = (torch.where(seen, position, 0.0) for position in components(pixels))
    if edges != "border":
        u = _around(u, width)
    is_batch = pixels.ndim > 4
    # Only of samples that stay where they are: the taps of a lattice have no gradient.
    is_fixed = pixels.ndim == 3 and len(pixels) > 1 and not (pixels.requires_grad or pixels.is_meta)
    if is_fixed and pixels.shape[-2] > 1 and not cubic:
        weights = seen.to(u) / seen.shape[-1] if shares is None else torch.where(seen, shares, 0.0)
        lattice = find_lattice(u, v, weights, image_size, edges)
        if lattice is not None:
            cells = lattice.outside
            some = None if shares is None else shares[cells]
            others = image_lookup(pixels[cells], seen[cells], image_size, some, edges) if len(cells) else None
            return SeparableLookup(lattice, others)
    if edges != "border" and not cubic and is_batch:
        grid = _grid(u + 1, v + 1, seen, (height + 2, width + 2))
        return PaddedLookup(edges == "sphere", grid, seen, image_size, shares)
    grid = _grid(u, v, seen, image_size)
    if (cubic or edges != "border") and not pixels.is_meta:
        ids = _leaving(u, v, seen, image_size, cubic)
        if len(ids):
            leaving = from_components(*(position.flatten(-2)[..., ids] for position in (u, v)))
            taps, weights = taps_across_edges(leaving, image_size, edges, cubic)
            weights = weights * seen.flatten(-2)[..., ids].unsqueeze(-1)
            return SeamLookup(ids, taps, weights, grid, seen, image_size, shares, cubic)
    return ImageLookup(grid, seen, image_size, shares, cubic)


class ImageLookup(PlacesInSinglePrecision):
    """Means over m positions each in an image whose outermost pixels are repeated.

    Args:
        grid: ``(*g, P, m, 2)``, the positions as ``grid_sample`` has them; far outside where nothing is seen.
        seen: ``(*g, P, m)``.
        image_size: (height, width).
        shares: as of ``image_lookup``.
        cubic: so is this.
    """

    grid: Tensor
    seen: Tensor | None
    shares: Tensor | None

    def __init__(
        self,
        grid: Float[Tensor, "*g P m 2"],
        seen: Bool[Tensor, "*#g P m"],
        image_size: tuple[int, int],
        shares: Float[Tensor, "*#g P m"] | None = None,
        cubic: bool = False,
    ) -> None:
        super().__init__()
        self.mode = "bicubic" if cubic else "bilinear"
        # An image of one row or column has no outside for grid_sample.
        tables = {"grid": grid, "shares": shares, "seen": seen if 1 in image_size else None}
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)

    def forward(self, images: Float[Tensor, "*images C h w"]) -> Float[Tensor, "*batch C P"]:
        """``images`` (*b, C, height, width) at the targets, (*b, C, P)."""
        result = self.interpolate(images)
        if self.seen is not None:
            result = torch.where(self.seen.unsqueeze(-3), result, 0.0)
        if self.shares is not None:
            return (result * self.shares.to(result.dtype).unsqueeze(-3)).sum(-1)
        return result.squeeze(-1) if result.shape[-1] == 1 else result.mean(-1)

    def interpolate(self, images: Float[Tensor, "*images C h w"]) -> Float[Tensor, "*batch C P m"]:
        """Return the values at all positions, (*b, C, P, m)."""
        size = images.shape[-3:]
        batch = broadcast_shapes(images.shape[:-3], self.grid.shape[:-3])
        # In half precision positions would be off.
        dtype, images = images.dtype, images.to(torch.promote_types(images.dtype, torch.float32))
        grid = self.grid.to(images.dtype).expand(*batch, *self.grid.shape[-3:])
        grid = grid.reshape(math.prod(batch), *grid.shape[-3:])
        flat = images.expand(*batch, *size).reshape(math.prod(batch), *size)
        samples = _sample(flat, grid, self.mode)
        return samples.reshape(*batch, size[0], *self.grid.shape[-3:-1]).to(dtype)


def _sample_at_once(images: Tensor, grid: Tensor, mode: str) -> Tensor:
    """Values ``(b, C, P, m)`` of images ``(b, C, h, w)`` at positions ``(b, P, m, 2)``."""
    return F.grid_sample(images, grid, mode, padding_mode="zeros", align_corners=True)


def _sample_in_chunks(images: Tensor, grid: Tensor, mode: str) -> Tensor:
    """Cut the results of one image into chunks: on a CPU ``grid_sample`` gives each image of a batch to one thread."""
    if len(images) != 1 or torch.get_num_threads() == 1 or not grid.numel():
        return NotImplemented
    if torch.is_grad_enabled() and (images.requires_grad or grid.requires_grad):
        return NotImplemented
    chunks = next(chunks for chunks in range(_MAX_CHUNKS, 0, -1) if grid.shape[1] % chunks == 0)
    chunked = grid.view(chunks, -1, *grid.shape[2:])
    samples = _sample_at_once(images.expand(chunks, *images.shape[1:]), chunked, mode)
    return samples.transpose(0, 1).flatten(1, 2)[None]


_sample = Operator(_sample_at_once, cpu=_sample_in_chunks)


class SeamLookup(ImageLookup):
    """``ImageLookup`` that reads the few positions whose kernel leaves the image entry by entry.

    Args:
        ids: ``(k,)``, which of the P x m positions are replaced.
        taps: ``(*g, k, t)``, flat ids of the pixels that each is interpolated from.
        weights: ``(*g, k, t)``, zero where nothing is seen.
        positions: arguments of ``ImageLookup``.
    """

    ids: Tensor
    taps: Tensor
    weights: Tensor

    def __init__(
        self,
        ids: Int[Tensor, " k"],
        taps: Int[Tensor, "*g k t"],
        weights: Float[Tensor, "*g k t"],
        *positions: Any,
    ) -> None:
        super().__init__(*positions)
        for name, table in {"ids": ids, "taps": taps, "weights": weights}.items():
            self.register_buffer(name, table, persistent=False)

    def interpolate(self, images: Float[Tensor, "*images C h w"]) -> Float[Tensor, "*batch C P m"]:
        """Return the values at all positions, (*b, C, P, m)."""
        edge = weighted_sums(images.flatten(-2), self.taps, self.weights)
        result = super().interpolate(images).contiguous()  # grid_sample may have put channels side by side
        flat = result.view(*result.shape[:-2], -1)
        flat.index_copy_(-1, self.ids, edge.expand(*flat.shape[:-1], -1))
        return result


class PaddedLookup(ImageLookup):
    """``ImageLookup`` of a panorama that gets one more pixel at each edge first.

    Args:
        poles: whether the panorama reaches up to the poles.
        positions: arguments of ``ImageLookup``, the grid as in the padded panorama.
    """

    def __init__(self, poles: bool, *positions: Any) -> None:
        super().__init__(*positions)
        self.poles = poles

    def interpolate(self, images: Float[Tensor, "*images C h w"]) -> Float[Tensor, "*batch C P m"]:
        """Return the values at all positions, (*b, C, P, m)."""
        return super().interpolate(wrap_panorama(images, poles=self.poles))


def _grid(u: Tensor, v: Tensor, seen: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Positions as ``grid_sample`` has them, exactly -1 and 1 at the outermost centres: nothing beyond is mixed in."""
    height, width = image_size
    normalised = []
    for position, last in ((u, width - 1), (v, height - 1)):
        inside = position.clamp(0, last)
        normalised.append(torch.where(seen, inside * (2 / max(last, 1)) - 1, _OUTSIDE))
    return from_components(*normalised)


def _leaving(u: Tensor, v: Tensor, seen: Tensor, image_size: tuple[int, int], cubic: bool) -> Tensor:
    """Which of the P x m positions have a kernel that leaves the image, in any lookup of a batch."""
    reach = 1 if cubic else 0
    leaves = torch.zeros_like(seen)
    for position, length in ((u, image_size[1]), (v, image_size[0])):
        first = position.detach().floor() - reach
        leaves = leaves | (first < 0) | (first > length - 2 - 2 * reach)
    leaves = leaves & seen
    return leaves.flatten(-2).reshape(-1, leaves.shape[-2:].numel()).any(0).nonzero()[:, 0]


def _around(u: Tensor, width: int) -> Tensor:
    """Columns counted from the first half pixel of a panorama, whatever the number of turns; most are there already."""
    return torch.where((u < -0.5) | (u > width - 0.5), torch.remainder(u + 0.5, width) - 0.5, u)


def taps_across_edges(
    pixels: Float[Tensor, "*batch 2"], image_size: tuple[int, int], edges: str = "border", cubic: bool = False
) -> tuple[Int[Tensor, "*batch taps"], Float[Tensor, "*batch taps"]]:
    """Flat ids and weights ``(*, taps)`` that interpolate an image at ``pixels`` ``(*, 2)``, beyond its edges too.

    Args:
        pixels: (u, v), pixel centres at integers; weights are differentiable in them.
        image_size: (height, width).
        edges: ``"border"`` repeats the outermost pixels; ``"around"`` joins the left and the right edge; ``"sphere"``
            joins them, and a row beyond a pole is the pole's row seen from behind, half a turn further.
        cubic: whether for the bicubic kernel (16 taps) or the bilinear one (4); twice as many for ``"sphere"`` and an
            odd width.

    Examples:
        >>> ids, weights = taps_across_edges(torch.tensor([3.25, 0.0]), (1, 4), "around")
        >>> ids[:2], weights[:2]
        (tensor([3, 0]), tensor([0.7500, 0.2500]))
    """
    height, width = image_size
    u, v = pixels[..., :1], pixels[..., 1:]
    offsets = torch.arange(-1, 3, device=pixels.device) if cubic else torch.arange(2, device=pixels.device)
    rows = v.detach().floor().long() + offsets
    row_weights = _kernel(v - rows, cubic)
    columns = u.detach().floor().long() + offsets
    column_weights = _kernel(u - columns, cubic)
    shifts = [torch.zeros_like(rows)]
    if edges == "sphere":
        outside = (rows < 0) | (rows >= height)
        rows = torch.where(rows < 0, -1 - rows, torch.where(rows >= height, 2 * height - 1 - rows, rows))
        # An odd width has no pixel exactly behind, hence the mean of its two.
        shifts = [torch.where(outside, turn, 0) for turn in sorted({width // 2, (width + 1) // 2})]
    starts = rows.clamp(0, height - 1).unsqueeze(-1) * width
    weights = (row_weights.unsqueeze(-1) * column_weights.unsqueeze(-2)).flatten(-2) / len(shifts)
    ids = []
    for shift in shifts:
        column = columns.unsqueeze(-2) + shift.unsqueeze(-1)
        column = column.clamp(0, width - 1) if edges == "border" else column.remainder(width)
        ids.append((starts + column).flatten(-2))
    return torch.cat(ids, -1), torch.cat([weights] * len(shifts), -1)


def _kernel(distance: Tensor, cubic: bool) -> Tensor:
    """Weights of the linear kernel, or of Keys' cubic with the slope -0.75 that torch and OpenCV use."""
    x = distance.abs()
    if not cubic:
        return 1 - x
    inner = (1.25 * x - 2.25) * x * x + 1
    far = ((-0.75 * x + 3.75) * x - 6) * x + 3
    return torch.where(x <= 1, inner, far)
