# SPDX-License-Identifier: Apache-2.0
"""``bilinear_sample``: interpolation of images without a table.

Pixel centres have integer coordinates, the top-left pixel's is (u, v) = (0, 0).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.core import ShapeError, check_choice
from sphericalvision.geometry.directions import broadcast_shapes, in_single_precision
from sphericalvision.shapes import check_shapes


def wrap_panorama(
    image: Shaped[Tensor, "*batch h w"], sides: tuple[int, int, int, int] = (1, 1, 1, 1), poles: bool = True
) -> Shaped[Tensor, "*batch h_out w_out"]:
    """A panorama ``(*, h, w)`` continued across its left and right edge and by more rows above and below.

    Args:
        image: equirectangular, all around.
        sides: how many more columns and rows there are: left, right, top, bottom.
        poles: whether it reaches up to the poles; then beyond a pole its rows follow as seen from behind, else the
            outermost rows again.

    Examples:
        >>> wrap_panorama(torch.tensor([[1, 2, 3, 4]]).float())[0]
        tensor([2., 3., 4., 1., 2., 3.])
    """
    left, right, top, bottom = sides
    height, width = image.shape[-2:]

    def beyond(rows: Tensor) -> Tensor:
        if not poles:
            return rows
        behind = rows.flip(-2).roll(width // 2, -1)
        # An odd width has no pixel exactly behind, hence the mean of its two.
        return (behind + behind.roll(1, -1)) / 2 if width % 2 else behind

    image = torch.cat((beyond(image[..., :top, :]), image, beyond(image[..., height - bottom :, :])), -2)
    return torch.cat((image[..., width - left :], image, image[..., :right]), -1)


@check_shapes
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

    Examples:
        >>> image = torch.tensor([[[0.0, 10.0], [20.0, 30.0]]])
        >>> bilinear_sample(image, torch.tensor([[1.0, 0.0], [0.5, 0.5]])).tolist()
        [[10.0, 15.0]]
        >>> seam = torch.tensor([[1.5, 0.0]])
        >>> bilinear_sample(image[:, :1], seam, wrap_longitude=True).tolist()
        [[5.0]]
    """
    check_choice("padding", padding, ("border", "zeros"))
    pixels = in_single_precision(pixels)
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
    flat_image = in_single_precision(flat_image)  # places would be half a pixel off
    # grid_sample(align_corners=False) puts the centre of pixel i at (2 i + 1) / size - 1.
    grid = ((2 * pixels + 1) / size - 1).to(flat_image.dtype).expand(*batch, *pixels.shape[-2:])
    grid = grid.reshape(-1, 1, *pixels.shape[-2:])
    values = F.grid_sample(flat_image, grid, padding_mode=padding, align_corners=False)
    values = torch.where(grid.isnan().any(-1).unsqueeze(1), torch.nan, values)
    return values.reshape(*batch, image.shape[-3], pixels.shape[-2]).to(image.dtype)
