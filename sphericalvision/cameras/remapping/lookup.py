# SPDX-License-Identifier: Apache-2.0
"""Where the pixels of one camera lie in another, and values looked up there."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.models.equirectangular import EquirectangularCamera

__all__ = ["Lookup", "expand_batch", "source_pixels"]

_OUTSIDE = -9.0  # normalised coordinates so far out that grid_sample reads zeros there


def source_pixels(
    source: Camera, target: Camera, rotation: Tensor | None, positions: Tensor
) -> tuple[Tensor, Tensor]:
    """Pixels (*b, *, 2) of the source that show what the target shows at ``positions`` (*, 2), and validity (*b, *).

    Args:
        source: of any batch shape; batch shapes of both cameras and the rotation broadcast to *b.
        target: the camera whose pixels ``positions`` are.
        rotation: (*b, 3, 3), target_from_source.
        positions: (u, v); dtype and device of the answer.
    """
    turns = () if rotation is None else rotation.shape[:-2]
    batch = torch.broadcast_shapes(source.batch_shape, target.batch_shape, turns)
    directions, seen = _lift(target, batch).unproject(positions.expand(*batch, *positions.shape))
    if rotation is not None:
        # target_from_source turns the other way: its transpose acts on column vectors, itself on rows.
        turn = rotation.to(directions).expand(*batch, 3, 3).reshape(-1, 3, 3)
        directions = (directions.reshape(len(turn), -1, 3) @ turn).reshape(directions.shape)
    pixels, visible = _lift(source, batch).project(directions)
    return pixels, seen & visible


def expand_batch(table: Tensor, batch: tuple[int, ...], kept: int) -> Tensor:
    """A table (*g, ...) as (prod(batch), ...), its last ``kept`` dimensions as they are."""
    return table.expand(*batch, *table.shape[-kept:]).reshape(math.prod(batch), *table.shape[-kept:])


class Lookup(nn.Module):
    """Interpolated values of an image at fixed pixels: zero where not valid.

    Inside the image ``grid_sample`` does the work. A panorama continues beyond its edges: the few samples whose
    neighbours lie across the seam or beyond a pole ("across") are put together from ``taps``, pixels with weights. So
    do those of a bicubic kernel that leaves any image; it finds the border's pixels repeated there.

    Args:
        pixels: (*g, n, m, 2) as (u, v) of the full image.
        valid: (*g, n, m).
        source: the camera that took the image.
        interpolation: ``"bilinear"``, ``"bicubic"`` or ``"nearest"``.
        level: of the image's pyramid; each level halves the sides.
    """

    grid: Tensor
    across: Tensor | None
    taps: Tensor | None
    weights: Tensor | None

    def __init__(
        self, pixels: Tensor, valid: Tensor, source: Camera, interpolation: str = "bilinear", level: int = 0
    ) -> None:
        super().__init__()
        self.interpolation = interpolation
        self.level = level
        size = level_size(source.image_size, level)
        limits = pixels.new_tensor([size[1], size[0]])
        full = pixels.new_tensor([source.image_size[1], source.image_size[0]])
        pixels = torch.where(valid.unsqueeze(-1), (pixels + 0.5) * (limits / full) - 0.5, 0.0)
        panorama = isinstance(source, EquirectangularCamera)
        if interpolation == "nearest":
            column, row = torch.floor(pixels.detach() + 0.5).unbind(-1)
            pixels = torch.stack((column.remainder(size[1]) if panorama else column, row), dim=-1)
        # Exactly -1 and 1 at the outermost centres, so that nothing beyond them is ever mixed in.
        inside = pixels.clamp(torch.zeros_like(limits), limits - 1)
        grid = inside * (2 / (limits - 1).clamp(min=1)) - 1
        self.register_buffer("grid", torch.where(valid.unsqueeze(-1), grid, _OUTSIDE), persistent=False)
        across = taps = weights = None
        if interpolation == "bicubic" or (panorama and interpolation == "bilinear"):
            reach = 1 if interpolation == "bicubic" else 0
            first = pixels.detach().floor() - reach
            leaves = ((first < 0) | (first > limits - 2 - 2 * reach)).any(-1) & valid
            across = leaves.reshape(-1, *leaves.shape[-2:]).any(0).flatten().nonzero()[:, 0]
            near, usable = pixels.flatten(-3, -2)[..., across, :], valid.flatten(-2)[..., across]
            taps, weights = _taps(near, source, size, interpolation == "bicubic")
            weights = weights * usable.unsqueeze(-1)
            across = across if len(across) else None
        self.register_buffer("across", across, persistent=False)
        self.register_buffer("taps", taps, persistent=False)
        self.register_buffer("weights", weights, persistent=False)

    def forward(self, image: Tensor, batch: tuple[int, ...]) -> Tensor:
        """Values (prod(batch), c, n, m) of ``image`` (prod(batch), c, h, w) of this level, zero where not valid."""
        grid = expand_batch(self.grid, batch, 3).to(image.dtype)
        values = F.grid_sample(image, grid, self.interpolation, padding_mode="zeros", align_corners=True)
        if self.across is not None and self.taps is not None and self.weights is not None:
            taps = expand_batch(self.taps, batch, 2).flatten(1).unsqueeze(1)
            found = image.flatten(-2).gather(-1, taps.expand(-1, image.shape[1], -1))
            weights = expand_batch(self.weights, batch, 2).to(image.dtype).unsqueeze(1)
            found = (found.unflatten(-1, weights.shape[-2:]) * weights).sum(-1)
            values.view(*values.shape[:2], -1).index_copy_(-1, self.across, found)
        return values

    def index(self, image_size: tuple[int, int]) -> Tensor:
        """Flat pixel indices (*g, n, m) of a ``"nearest"`` lookup, 0 where not valid."""
        height, width = image_size
        grid = torch.where(self.grid > _OUTSIDE / 2, self.grid, -1.0)
        column, row = ((grid + 1) / 2 * grid.new_tensor([width - 1, height - 1])).round().long().unbind(-1)
        return row * width + column


def level_size(image_size: tuple[int, int], level: int) -> tuple[int, int]:
    """(height, width) of an image's pyramid level."""
    height, width = image_size
    return (max(1, -(-height // 2**level)), max(1, -(-width // 2**level)))


def _taps(pixels: Tensor, source: Camera, size: tuple[int, int], bicubic: bool) -> tuple[Tensor, Tensor]:
    """Flat indices and weights (*g, k, taps) that interpolate at ``pixels`` (*g, k, 2) across an image's edges.

    A row beyond a pole of a full panorama is the pole's row seen from behind, half a turn further.
    """
    height, width = size
    panorama = isinstance(source, EquirectangularCamera)
    poles = isinstance(source, EquirectangularCamera) and source.vertical_field_of_view > math.pi - 1e-6
    u, v = pixels[..., :1], pixels[..., 1:]
    offsets = torch.arange(-1, 3, device=pixels.device) if bicubic else torch.arange(2, device=pixels.device)
    rows = v.detach().floor().long() + offsets
    row_weights = _kernel(v - rows, bicubic)
    beyond = (rows < 0) | (rows >= height)
    if poles:
        u = u + torch.where(beyond, width / 2, 0.0).to(u.dtype)
        rows = torch.where(rows < 0, -1 - rows, torch.where(rows >= height, 2 * height - 1 - rows, rows))
    u = u.unsqueeze(-1)
    columns = u.detach().floor().long() + offsets
    column_weights = _kernel(u - columns, bicubic)
    columns = columns.remainder(width) if panorama else columns.clamp(0, width - 1)
    taps = rows.clamp(0, height - 1).unsqueeze(-1) * width + columns
    weights = row_weights.unsqueeze(-1) * column_weights
    return taps.flatten(-2), weights.expand(taps.shape).flatten(-2)


def _kernel(distance: Tensor, bicubic: bool) -> Tensor:
    """Weights of the linear kernel, or of Keys' cubic with the slope -0.75 that torch and OpenCV use."""
    x = distance.abs()
    if not bicubic:
        return 1 - x
    near = (1.25 * x - 2.25) * x * x + 1
    far = ((-0.75 * x + 3.75) * x - 6) * x + 3
    return torch.where(x <= 1, near, far)


def _lift(camera: Camera, batch: tuple[int, ...]) -> Camera:
    """The camera with leading dimensions of size one, as many as ``batch`` has more than it."""
    missing = len(batch) - len(camera.batch_shape)
    return camera._map(lambda tensor: tensor.reshape(*[1] * missing, *tensor.shape)) if missing else camera
