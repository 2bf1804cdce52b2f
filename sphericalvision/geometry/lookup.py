# SPDX-License-Identifier: Apache-2.0
"""Lookups: where each of P results is found in something flat, worked out once and applied often.

``bilinear_sample`` looks up once: pixel centres have integer coordinates, the top-left pixel's is (u, v) = (0, 0).

``weighted_rows`` reads few entries by number, with weights; a sweep reads the vertices of its triangles so, and
``Lookup`` is the module around it: vertices, pixels of HEALPix, one pixel for a label.
``ImageLookup`` interpolates in images; ``grid_sample`` finds the pixels and weights of a position faster than a table
of them is read. Both are modules whose tables move with ``.to`` and are not saved, map values ``(*b, C, ...)`` to
``(*b, C, P)``, give zero where nothing is seen, and are differentiable in values and in what the tables were made of.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Self

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from sphericalvision.core import ShapeError, check_choice, check_floating, check_last_dim, check_tensor
from sphericalvision.geometry.directions import broadcast_shapes, components, from_components
from sphericalvision.kernels import uses_reference_kernels

__all__ = [
    "ImageLookup",
    "Lookup",
    "PlacesInSinglePrecision",
    "bilinear_sample",
    "taps_across_edges",
    "weighted_rows",
    "weighted_sums",
    "wrap_panorama",
]

HALF = (torch.float16, torch.bfloat16)
_OUTSIDE = -9.0  # normalised coordinates so far out that grid_sample reads zeros there
_MOST_PARTS = 8  # of the results of one image, to be worked on by different threads


def wrap_panorama(image: Float[Tensor, "*batch h w"], poles: bool = True) -> Float[Tensor, "*batch h+2 w+2"]:
    """A panorama ``(*, h, w)`` with one more column on either side and one more row above and below.

    Args:
        image: equirectangular, all around.
        poles: whether it reaches up to the poles; then beyond a pole stands its row as seen from behind, else the
            row is repeated.

    Examples:
        >>> wrap_panorama(torch.tensor([[1, 2, 3, 4]]).float())[0]
        tensor([2., 3., 4., 1., 2., 3.])
    """
    width = image.shape[-1]

    def beyond(row: Tensor) -> Tensor:  # an odd width has no pixel exactly behind, hence the mean of its two
        return (row.roll(width // 2, -1) + row.roll((width + 1) // 2, -1)) / 2 if poles else row

    image = torch.cat((beyond(image[..., :1, :]), image, beyond(image[..., -1:, :])), -2)
    return torch.cat((image[..., -1:], image, image[..., :1]), -1)


def bilinear_sample(
    image: Float[Tensor, "*images c h w"],
    pixels: Float[Tensor, "*places n 2"],
    wrap_longitude: bool = False,
    padding: str = "border",
) -> Float[Tensor, "*batch c n"]:
    """Values (*b, c, n) of ``image`` (*b, c, h, w) at ``pixels`` (*b, n, 2), given as (u, v).

    Args:
        image: floating point, as then are the values; its leading dimensions broadcast with those of ``pixels``.
        pixels: (u, v) with integer pixel centres; the value at a NaN is NaN.
        wrap_longitude: the image is a full equirectangular panorama: its left and right edges meet, and beyond
            a pole the panorama continues on the opposite side.
        padding: beyond the outermost pixel centres ``"border"`` repeats them and ``"zeros"`` fades to zero.

    Raises:
        ArgumentError: the image is of an integer type, or ``padding`` is unknown.
        ShapeError: the shapes are not as above.

    Examples:
        >>> image = torch.tensor([[[0.0, 10.0], [20.0, 30.0]]])
        >>> bilinear_sample(image, torch.tensor([[1.0, 0.0], [0.5, 0.5]])).tolist()
        [[10.0, 15.0]]
        >>> seam = torch.tensor([[1.5, 0.0]])
        >>> bilinear_sample(image[:, :1], seam, wrap_longitude=True).tolist()
        [[5.0]]
    """
    check_choice("padding", padding, ("border", "zeros"))
    check_tensor("image", image, "(*b, c, h, w)")
    check_last_dim("pixels", pixels, 2)
    if image.ndim < 3 or pixels.ndim < 2:
        raise ShapeError(
            "image and pixels: expected shapes (*b, c, h, w) and (*b, n, 2), "
            f"got {tuple(image.shape)} and {tuple(pixels.shape)}"
        )
    check_floating("image", image)
    check_floating("pixels", pixels)
    pixels = pixels.to(torch.promote_types(pixels.dtype, torch.float32))
    height, width = image.shape[-2:]
    size = pixels.new_tensor([width, height])
    if wrap_longitude:
        u = torch.remainder(pixels[..., 0] + 0.5, width) - 0.5
        pixels = torch.stack((u, pixels[..., 1]), dim=-1) + 1
        image, size = wrap_panorama(image), size + 2
    try:
        batch = broadcast_shapes(image.shape[:-3], pixels.shape[:-2])
    except RuntimeError:
        raise ShapeError(
            "image and pixels: expected leading dimensions that broadcast with each other, "
            f"got {tuple(image.shape)} and {tuple(pixels.shape)}"
        ) from None
    if 0 in (*batch, pixels.shape[-2]):  # which grid_sample refuses
        none = image.flatten(-2)[..., :0].expand(*batch, -1, -1)
        return none.reshape(*batch, image.shape[-3], pixels.shape[-2])
    flat_image = image.expand(*batch, *image.shape[-3:]).reshape(-1, *image.shape[-3:])
    if image.dtype in HALF:  # whose places would be half a pixel off
        flat_image = flat_image.float()
    # grid_sample(align_corners=False) puts the centre of pixel i at (2 i + 1) / size - 1.
    grid = ((2 * pixels + 1) / size - 1).to(flat_image.dtype).expand(*batch, *pixels.shape[-2:])
    grid = grid.reshape(-1, 1, *pixels.shape[-2:])
    values = F.grid_sample(flat_image, grid, padding_mode=padding, align_corners=False)
    values = torch.where(grid.isnan().any(-1).unsqueeze(1), torch.nan, values)
    return values.reshape(*batch, image.shape[-3], pixels.shape[-2]).to(image.dtype)


def weighted_rows(
    rows: Float[Tensor, "size C"], ids: Int[Tensor, "P k"], weights: Float[Tensor, "P k"]
) -> Float[Tensor, "P C"]:
    """Weighted sums ``(P, C)`` of k rows ``(size, C)`` each: the one place where tables are read with weights.

    Rows are read at once, which is why those who read much keep the channels of an entry side by side. The kernel for
    it has first derivatives; under ``reference_kernels`` the sum is written out and has derivatives of any order. So it
    is for compilers, which make one loop of it.

    Args:
        rows: floating point.
        ids: of the rows, k for each of P sums.
        weights: of the ids' shape.

    Examples:
        >>> weighted_rows(torch.tensor([[1.0, 2.0], [5.0, 6.0]]), torch.tensor([[0, 1]]), torch.tensor([[0.5, 0.5]]))
        tensor([[3., 4.]])
    """
    weights = weights.to(rows.dtype)
    # The kernel has a warp of a CUDA device read a row, which few channels leave idle: a tenth of a frame at four.
    is_narrow = rows.is_cuda and rows.shape[-1] < 32
    if is_narrow or uses_reference_kernels() or torch.compiler.is_compiling():
        return _term_by_term(rows, ids, weights)
    return F.embedding_bag(ids, rows, per_sample_weights=weights, mode="sum")


def _term_by_term(rows: Tensor, ids: Tensor, weights: Tensor) -> Tensor:
    """The same, slower, with derivatives of any order."""
    total = rows.index_select(0, ids[:, 0]) * weights[:, :1]
    for k in range(1, ids.shape[-1]):
        total = total + rows.index_select(0, ids[:, k]) * weights[:, k, None]
    return total


def weighted_sums(
    values: Float[Tensor, "*values C size"], ids: Int[Tensor, "*ids P k"], weights: Float[Tensor, "*ids P k"]
) -> Float[Tensor, "*batch C P"]:
    """Weighted sums ``(*b, C, P)`` of few of the values ``(*b, C, size)``.

    Args:
        values: floating point.
        ids: ``(*b, P, k)``, or ``(P, k)`` for all of the batch: which k values are read for each of P sums.
        weights: of the ids' shape.

    Examples:
        >>> weighted_sums(torch.tensor([[1.0, 5.0]]), torch.tensor([[0, 1]]), torch.tensor([[0.25, 0.75]]))
        tensor([[4.]])
    """
    weights = weights.to(values.dtype)
    if ids.ndim > 2:
        batch = broadcast_shapes(values.shape[:-2], ids.shape[:-2])
        values = values.expand(*batch, *values.shape[-2:])
        shape = (*batch, values.shape[-2], ids.shape[-2])
        total = values.new_zeros(())
        for k in range(ids.shape[-1]):
            total = total + values.gather(-1, ids[..., None, :, k].expand(shape)) * weights[..., None, :, k]
        return total
    if ids.numel() < values.shape[-1]:  # few of many: the rest is not touched
        terms = values.index_select(-1, ids.flatten()).unflatten(-1, tuple(ids.shape))
        return (terms * weights).sum(-1)
    wants_grad = torch.is_grad_enabled() and (values.requires_grad or weights.requires_grad)
    if wants_grad and values.device.type == "cpu" and torch.compiler.is_compiling():
        # Inductor of torch 2.13 adds the slopes of transposed rows up at wrong places, and past their end.
        total = values.new_zeros(())
        for k in range(ids.shape[-1]):
            total = total + values.index_select(-1, ids[:, k]) * weights[:, k]
        return total
    # All channels of a value side by side, so that they are read at once.
    rows = values.reshape(math.prod(values.shape[:-1]), values.shape[-1]).t().contiguous()
    sums = (_term_by_term if wants_grad else weighted_rows)(rows, ids, weights)
    return sums.t().reshape(*values.shape[:-1], len(ids)).contiguous()


class PlacesInSinglePrecision(nn.Module):
    """A module whose tables say where things are: of a network that is cast to half precision they become float32.

    Examples:
        >>> middle = Lookup(torch.tensor([[0, 1]]), torch.full((1, 2), 0.5)).half()
        >>> middle.weights.dtype
        torch.float32
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        def exact(table: Tensor) -> Tensor:
            cast = fn(table)
            return table.to(cast.device, torch.float32) if cast.dtype in HALF else cast

        return super()._apply(exact, recurse)


class Lookup(PlacesInSinglePrecision):
    """Results that are weighted sums of k entries each, or one entry each, of any dtype.

    Args:
        ids: ``(*g, P, k)`` into the flattened source, or ``(*g, P)`` for one entry each, which are not weighted.
        weights: ``(*g, P, k)``; none with ids of one entry each.
        seen: ``(*g, P)``, where there is a result; everywhere if not given.
        dims: dimensions of the source that ids count through.

    Examples:
        >>> middle = Lookup(torch.tensor([[0, 1], [2, 3]]), torch.full((2, 2), 0.5))
        >>> middle(torch.tensor([[1.0, 3.0, 5.0, 7.0]]))
        tensor([[2., 6.]])
        >>> Lookup(torch.tensor([3, 0]), dims=2)(torch.tensor([[[1, 2], [3, 4]]]))
        tensor([[4, 1]])
    """

    ids: Tensor
    weights: Tensor | None
    seen: Tensor | None

    def __init__(
        self,
        ids: Int[Tensor, " ..."],
        weights: Float[Tensor, "*#g P k"] | None = None,
        seen: Bool[Tensor, "*#g P"] | None = None,
        dims: int = 1,
    ) -> None:
        super().__init__()
        self.dims = dims
        for name, table in (("ids", ids), ("weights", weights), ("seen", seen)):
            self.register_buffer(name, table, persistent=False)

    def forward(self, values: Shaped[Tensor, " ..."]) -> Shaped[Tensor, "*batch C P"]:
        """``values`` (*b, C, *source) at the targets, (*b, C, P)."""
        values = values.flatten(-self.dims)
        if self.weights is not None:
            result = weighted_sums(values, self.ids, self.weights)
        elif self.ids.ndim == 1:
            result = values.index_select(-1, self.ids)
        else:
            batch = broadcast_shapes(values.shape[:-2], self.ids.shape[:-1])
            ids = self.ids.unsqueeze(-2).expand(*batch, values.shape[-2], -1)
            result = values.expand(*batch, *values.shape[-2:]).gather(-1, ids)
        return (
            result
            if self.seen is None
            else torch.where(self.seen.unsqueeze(-2), result, result.new_zeros(()))
        )


class ImageLookup(PlacesInSinglePrecision):
    """Results that are means over m places each in an image, interpolated between pixels.

    Args:
        pixels: ``(*g, P, m, 2)`` as (u, v), pixel centres at integers.
        seen: ``(*g, P, m)``; places that are not seen count as zero.
        image_size: (height, width).
        shares: ``(*g, P, m)`` of the m places in their result; all the same if not given.
        edges: what continues an image beyond its outermost centres: ``"border"``, these pixels again; ``"around"``,
            left and right edges meet; ``"sphere"``, these, and beyond the poles the opposite side.
        cubic: whether to interpolate with the bicubic kernel in place of the bilinear one.

    Examples:
        >>> between = ImageLookup(torch.tensor([[[0.5, 0.0]], [[9.0, 0.0]]]), torch.tensor([[True], [False]]), (1, 4))
        >>> between(torch.tensor([[[2.0, 4.0, 6.0, 8.0]]]))
        tensor([[3., 0.]])
    """

    grid: Tensor
    seen: Tensor | None
    shares: Tensor | None
    across: Tensor | None
    across_ids: Tensor | None
    across_weights: Tensor | None

    def __init__(
        self,
        pixels: Float[Tensor, "*#g P m 2"],
        seen: Bool[Tensor, "*#g P m"],
        image_size: tuple[int, int],
        shares: Float[Tensor, "*#g P m"] | None = None,
        edges: str = "border",
        cubic: bool = False,
    ) -> None:
        super().__init__()
        self.edges, self.mode = edges, "bicubic" if cubic else "bilinear"
        # A batch of lookups has places at the edges nearly everywhere: there a panorama is continued by a pixel.
        self.wraps = edges != "border" and not cubic and pixels.ndim > 4
        height, width = image_size
        u, v = (torch.where(seen, position, 0.0) for position in components(pixels))
        if edges != "border":
            u = _around(u, width)
        margin = 2 if self.wraps else 0
        grid = []
        for position, last in ((u, width - 1 + margin), (v, height - 1 + margin)):
            # Exactly -1 and 1 at the outermost centres, so that nothing beyond them is ever mixed in.
            inside = (position + 1 if self.wraps else position).clamp(0, last)
            grid.append(torch.where(seen, inside * (2 / max(last, 1)) - 1, _OUTSIDE))
        # An image of one row or column has no outside for grid_sample.
        tables = {"grid": from_components(*grid), "shares": shares, "seen": seen if 1 in image_size else None}
        tables |= dict.fromkeys(("across", "across_ids", "across_weights"))
        if (cubic or edges != "border") and not (self.wraps or pixels.is_meta):
            # grid_sample knows no such edges: the few places whose kernel leaves the image are read entry by entry.
            reach = 1 if cubic else 0
            leaves = torch.zeros_like(seen)
            for position, length in ((u, width), (v, height)):
                first = position.detach().floor() - reach
                leaves = leaves | (first < 0) | (first > length - 2 - 2 * reach)
            leaves = leaves & seen
            across = leaves.flatten(-2).reshape(-1, leaves.shape[-2:].numel()).any(0).nonzero()[:, 0]
            if len(across):
                near = from_components(*(position.flatten(-2)[..., across] for position in (u, v)))
                usable = seen.flatten(-2)[..., across]
                ids, weights = taps_across_edges(near, image_size, edges, cubic)
                weights = weights * usable.unsqueeze(-1)
                tables |= {"across": across, "across_ids": ids, "across_weights": weights}
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)

    def forward(self, images: Float[Tensor, "*images C h w"]) -> Float[Tensor, "*batch C P"]:
        """``images`` (*b, C, height, width) at the targets, (*b, C, P)."""
        result = self._interpolated(images)
        if self.across is not None and self.across_ids is not None and self.across_weights is not None:
            edge = weighted_sums(images.flatten(-2), self.across_ids, self.across_weights)
            result = result.contiguous()  # the interpolation may have put its channels side by side
            result.view(*result.shape[:-2], -1).index_copy_(
                -1, self.across, edge.expand(*result.shape[:-2], -1)
            )
        if self.seen is not None:
            result = torch.where(self.seen.unsqueeze(-3), result, 0.0)
        if self.shares is not None:
            return (result * self.shares.to(result.dtype).unsqueeze(-3)).sum(-1)
        return result.squeeze(-1) if result.shape[-1] == 1 else result.mean(-1)

    def _interpolated(self, images: Tensor) -> Tensor:
        """What ``grid_sample`` finds, (*b, C, P, m)."""
        if self.wraps:
            images = wrap_panorama(images, poles=self.edges == "sphere")
        size = images.shape[-3:]
        batch = broadcast_shapes(images.shape[:-3], self.grid.shape[:-3])
        dtype = images.dtype
        images = images.to(torch.promote_types(dtype, torch.float32))  # in half precision places would be off
        grid = self.grid.to(images.dtype).expand(*batch, *self.grid.shape[-3:])
        grid = grid.reshape(math.prod(batch), *grid.shape[-3:])
        flat = images.expand(*batch, *size).reshape(math.prod(batch), *size)
        parts = self._parts(flat)
        if parts > 1:
            grid, flat = grid.view(parts, -1, *grid.shape[2:]), flat.expand(parts, *size)
        samples = F.grid_sample(flat, grid, self.mode, padding_mode="zeros", align_corners=True)
        if parts > 1:
            samples = samples.transpose(0, 1)
        return samples.reshape(*batch, size[0], *self.grid.shape[-3:-1]).to(dtype)

    def _parts(self, images: Tensor) -> int:
        """How many parts to cut results into: on a CPU ``grid_sample`` gives each image of a batch to one thread."""
        if torch.compiler.is_compiling() or images.shape[0] > 1 or images.device.type != "cpu":
            return 1
        if torch.get_num_threads() == 1 or not self.grid.numel():
            return 1
        if torch.is_grad_enabled() and (images.requires_grad or self.grid.requires_grad):
            return 1
        count = self.grid.shape[-3]
        return next(parts for parts in range(_MOST_PARTS, 0, -1) if count % parts == 0)


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
        beyond = (rows < 0) | (rows >= height)
        rows = torch.where(rows < 0, -1 - rows, torch.where(rows >= height, 2 * height - 1 - rows, rows))
        # An odd width has no pixel exactly behind, hence the mean of its two.
        shifts = [torch.where(beyond, turn, 0) for turn in sorted({width // 2, (width + 1) // 2})]
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
    near = (1.25 * x - 2.25) * x * x + 1
    far = ((-0.75 * x + 3.75) * x - 6) * x + 3
    return torch.where(x <= 1, near, far)
