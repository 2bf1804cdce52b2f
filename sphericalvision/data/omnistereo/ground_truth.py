# SPDX-License-Identifier: Apache-2.0
"""The two encodings of ground-truth inverse depth in the omnidirectional stereo sets.

* PNG release: one 16-bit channel, ``1 / depth = value / (65500 * min_depth)``; zero is infinity. The step
  is 2.8e-5 1/m at 0.55 m, and a value for "unknown" does not exist.
* TIFF release: two pages, an 8-bit RGB thumbnail first and float32 inverse depth in 1/m second. Most image
  readers return the thumbnail. Files with the float page alone exist, too. NaN and negative mean "unknown".
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Integer
from torch import Tensor

from sphericalvision.core import ArgumentError, FileFormatError, ShapeError
from sphericalvision.io.images import read_pages, write_pages
from sphericalvision.shapes import check_shapes

PNG_SCALE = 65500
"""PNG value of the inverse of the minimum depth."""


class GroundTruth(NamedTuple):
    """Panorama of inverse depth in 1/m (0 is infinity) and where it is known; both ``(H, W)``."""

    inverse_depth: Float[Tensor, "H W"]
    valid: Bool[Tensor, "H W"]


def check_panorama_size(height: int, width: int) -> None:
    """Raise ``ShapeError`` unless a panorama has width = 2 · height, or 4 · height as in the urban sets.

    Pixels are square and columns go once around, so the former shows the whole sphere and the latter latitudes within
    45°: ``Equirectangular.with_square_pixels``.

    Examples:
        >>> check_panorama_size(160, 640)
    """
    if height < 1 or width not in (2 * height, 4 * height):
        raise ShapeError(
            f"panorama: expected width = 2 x height (full sphere) or 4 x height (latitudes within "
            f"45 degrees), got height {height}, width {width}"
        )


def inverse_depth_from_png(values: Integer[Tensor, "*values"], min_depth: float) -> Float[Tensor, "*values"]:
    """Inverse depth in 1/m of PNG values of any shape, in float32.

    Examples:
        >>> inverse_depth_from_png(torch.tensor([0, 65500]), min_depth=0.5)
        tensor([0., 2.])
    """
    return (values.to(torch.float64) / (PNG_SCALE * min_depth)).to(torch.float32)


def png_from_inverse_depth(
    inverse_depth: Float[Tensor, "*values"], min_depth: float
) -> Int[Tensor, "*values"]:
    """PNG values (int32, 0 to 65535) of inverse depth in 1/m; inverts ``inverse_depth_from_png``.

    Points nearer than ``min_depth`` by more than 0.05 % do not fit in 16 bits: they get the largest value.

    Examples:
        >>> png_from_inverse_depth(torch.tensor([0.0, 2.0]), min_depth=0.5)
        tensor([    0, 65500], dtype=torch.int32)
    """
    levels = (inverse_depth.to(torch.float64) * (PNG_SCALE * min_depth)).round()
    return levels.clamp(0, 65535).to(torch.int32)


def read_ground_truth(path: str | Path, min_depth: float) -> GroundTruth:
    """Read ground truth of either encoding, which is recognised by the file's content.

    Args:
        path: 16-bit PNG or float TIFF of one or two pages.
        min_depth: metres; scales the PNG encoding, TIFF files hold 1/m and do not need it.

    Raises:
        MissingFileError: there is no such file.
        FileFormatError: no page has float32 or uint16 pixels of one channel, or the size is no panorama's.
    """
    pages = read_pages(path, "ground-truth inverse depth")
    page = pages[-1] if len(pages) <= 2 else None
    kinds = ", then ".join(f"{page.dtype} {page.shape}" for page in pages)
    if page is None or page.ndim != 2 or page.dtype not in (np.uint16, np.float32, np.float64):
        raise FileFormatError(
            f"{path}: expected a 16-bit PNG or a float TIFF (one page, or a thumbnail and a float page), "
            f"got {len(pages)} page(s): {kinds}. A lone 8-bit RGB page is the thumbnail, saved again by "
            f"another program: take the original file."
        )
    try:
        check_panorama_size(*page.shape)
    except ShapeError as error:
        raise FileFormatError(f"{path}: {error}") from None
    if page.dtype == np.uint16:
        values = inverse_depth_from_png(torch.from_numpy(page.astype(np.int32)), min_depth)
        return GroundTruth(values, torch.ones_like(values, dtype=torch.bool))
    values = torch.from_numpy(page.astype(np.float32))
    valid = values.isfinite() & (values >= 0)
    return GroundTruth(torch.where(valid, values, 0.0), valid)


@check_shapes
def write_ground_truth(
    path: str | Path,
    inverse_depth: Float[Tensor, "H W"],
    min_depth: float,
    valid: Bool[Tensor, "H W"] | None = None,
) -> None:
    """Write a panorama ``(H, W)`` of inverse depth in the encoding of the suffix (.png or .tiff).

    The TIFF encoding is exact. The PNG encoding is exact to half a step, 0.5 / (65500 * min_depth) 1/m;
    points nearer than ``min_depth`` are clipped there with a warning.

    Raises:
        ShapeError: no panorama (see ``check_panorama_size``).
        ArgumentError: another suffix, or unknown depth somewhere while the encoding is PNG.
    """
    path = Path(path)
    check_panorama_size(*inverse_depth.shape)
    values = inverse_depth.detach().to("cpu", torch.float32)
    mask = values.isfinite() & (values >= 0)
    if valid is not None:
        mask &= valid.cpu()
    if path.suffix == ".tiff":
        stored = torch.where(mask, values, torch.nan).numpy()
        write_pages(path, [_thumbnail(values, mask, min_depth), stored])
    elif path.suffix == ".png":
        if not mask.all():
            raise ArgumentError(
                f"{path.name}: {int((~mask).sum())} points of inverse_depth are unknown (invalid, NaN or "
                f"negative), which the PNG encoding cannot say. Write the TIFF release instead."
            )
        too_near = values.to(torch.float64) * (PNG_SCALE * min_depth) > 65535.5
        if too_near.any():
            warnings.warn(
                f"{path.name}: {int(too_near.sum())} points are nearer than min_depth = "
                f"{min_depth:g} m and are written as {PNG_SCALE * min_depth / 65535:.4g} m. "
                f"Give a smaller min_depth to keep them.",
                stacklevel=2,
            )
        write_pages(path, [png_from_inverse_depth(values, min_depth).numpy().astype(np.uint16)])
    else:
        raise ArgumentError(f"path: expected the suffix .png or .tiff, got {path.name!r}")


def _thumbnail(inverse_depth: torch.Tensor, valid: torch.Tensor, min_depth: float) -> np.ndarray:
    """Grey picture of inverse depth, white at ``min_depth``; what ordinary viewers show of the TIFF."""
    grey = torch.where(valid, inverse_depth * min_depth, 0.0).clamp(0, 1)
    return (grey * 255).round().to(torch.uint8)[..., None].expand(-1, -1, 3).numpy()
