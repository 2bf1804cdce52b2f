# SPDX-License-Identifier: Apache-2.0
"""Images of one camera as another would have taken them from the same place."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, nn

from sphericalvision.cameras.base import Camera
from sphericalvision.cameras.checks import check_image, check_rotation
from sphericalvision.cameras.remapping.area import (
    CellGroup,
    PyramidLookup,
    cell_groups,
    footprint,
    lookup_at_level,
    pixel_samples,
)
from sphericalvision.cameras.remapping.lookup import nearest_pixel, source_pixels
from sphericalvision.core import check_choice, check_tensor, check_type
from sphericalvision.geometry.image_lookup import image_lookup
from sphericalvision.geometry.lookup import Lookup
from sphericalvision.geometry.masked_lookup import LookupModule, MaskedLookup

REMAP_MODES = ("bilinear", "area", "bicubic", "nearest", "depth")


def remap(
    image: Shaped[Tensor, "*images c h w"],
    source: Camera,
    target: Camera,
    rotation: Float[Tensor, "*turns 3 3"] | None = None,
    mode: str = "bilinear",
    fill: float = 0.0,
    mask: Shaped[Tensor, "*masks h w"] | None = None,
) -> Shaped[Tensor, "*batch c rows columns"]:
    """The image that ``target`` would have taken from the same place as ``source``.

    Differentiable with respect to the image and, except for ``"nearest"``, the rotation and the intrinsics of both
    cameras. For many images of the same pair of cameras ``Remap`` is faster: it computes the lookup table once.

    Args:
        image: ``(*b, c, h, w)`` as taken by ``source``. Floating point, or of any type for ``"nearest"``.
        source: camera that took the image; batch dimensions of image, cameras and rotation broadcast.
        target: camera to imitate.
        rotation: ``(*b, 3, 3)``, target_from_source: what the source sees in direction d, the target sees in
            ``rotation @ d``. None: both have the same orientation.
        mode: ``"bilinear"`` reads four pixels around a point and aliases where the image shrinks. ``"area"`` is
            bilinear where it grows, and the mean over the area of the target pixel where it shrinks. ``"bicubic"`` is
            sharper and may overshoot. ``"nearest"`` creates no new values: for labels and masks.
            ``"depth"`` is for depth along the rays: linear in its inverse, so that planes stay planes, infinity
            is a depth, and unknown pixels (NaN, zero, negative) are ignored; unknown results are ``fill``.
        fill: value where the source or the target does not see, see ``remap_mask``.
        mask: ``(*b, h, w)``, pixels of the image that may be used (bool, or nonzero). Results are means over usable
            pixels; a target pixel is valid if it touches one.

    Returns:
        ``(*b, c, h', w')`` of the image's dtype.

    Raises:
        ShapeError: image or mask are not of the source's size, or the rotation is no 3 x 3 matrix.
        ArgumentError: an unknown mode, integers in another mode than ``"nearest"``, a mask with ``"bicubic"``, or a
            fill that the image's type cannot hold.

    References:
        L. Williams, "Pyramidal parametrics", SIGGRAPH 1983, for the averaged images of ``"area"``.

    Examples:
        >>> import math, torch
        >>> from sphericalvision.cameras import FisheyeCamera, PinholeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((64, 64), math.radians(200))
        >>> pinhole = PinholeCamera([40.0, 40.0], [39.5, 29.5], (60, 80))
        >>> remap(torch.ones(3, 64, 64), fisheye, pinhole).shape, remap_mask(fisheye, pinhole).all()
        (torch.Size([3, 60, 80]), tensor(True))
    """
    check_type("source", source, Camera)
    check_image("image", image, source.image_size)
    result: Tensor = remap_tables(source, target, rotation, mode, fill, mask, image.device)(image)
    return result


@torch.no_grad()
def remap_mask(
    source: Camera,
    target: Camera,
    rotation: Float[Tensor, "*turns 3 3"] | None = None,
    mode: str = "bilinear",
    mask: Shaped[Tensor, "*masks h w"] | None = None,
) -> Bool[Tensor, "*batch rows columns"]:
    """Return where ``remap`` finds values, bool ``(*b, h', w')``: where both cameras look and, with a mask, usable
    pixels were found.

    For depth, ``mask=depth > 0`` says which pixels are known. Errors are those of ``remap``.

    Examples:
        >>> from sphericalvision.cameras import EquirectangularCamera, FisheyeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((64, 64), 3.1416)
        >>> round(remap_mask(fisheye, EquirectangularCamera((32, 64))).double().mean().item(), 1)
        0.5
    """
    device = next((t.device for t in (mask, rotation) if t is not None), source.device)
    return remap_tables(source, target, rotation, mode, 0.0, mask, device).mask()


class Remap(LookupModule):
    """``remap`` between two fixed cameras, with tables that are computed once.

    The tables are computed in float64 and kept in ``dtype`` as buffers that are not part of the state dict; they move
    with ``.to`` and have no gradient. A call costs little more than one ``grid_sample``; with ``"area"``, up to 64
    samples for every target pixel where the image shrinks. ``mask()`` returns where results are valid. Errors are those
    of ``remap``.

    Args:
        source: camera that takes the images.
        target: camera to imitate.
        rotation: ``(*b, 3, 3)``, target_from_source.
        mode: one of ``REMAP_MODES``, see ``remap``.
        fill: value where not valid.
        mask: ``(*b, h, w)``, usable pixels of every image.
        dtype: of the tables; torch's default if not given.
        device: of the tables; the source's if not given.

    Examples:
        >>> import math
        >>> from sphericalvision.cameras import EquirectangularCamera, FisheyeCamera
        >>> fisheye = FisheyeCamera.from_field_of_view((64, 64), math.radians(180))
        >>> to_panorama = Remap(fisheye, EquirectangularCamera((32, 64)), mode="area")
        >>> to_panorama
        Remap((64, 64) -> (32, 64), mode='area')
        >>> to_panorama(torch.ones(5, 3, 64, 64)).shape, to_panorama.mask().shape
        (torch.Size([5, 3, 32, 64]), torch.Size([32, 64]))
    """

    @torch.no_grad()
    def __init__(
        self,
        source: Camera,
        target: Camera,
        rotation: Float[Tensor, "*turns 3 3"] | None = None,
        mode: str = "bilinear",
        fill: float = 0.0,
        mask: Shaped[Tensor, "*masks h w"] | None = None,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        made_on = "meta" if source.device.type == "meta" else "cpu"
        rotation = None if rotation is None else rotation.to(made_on)
        tables = remap_tables(source, target, rotation, mode, fill, mask, made_on)
        self.tables = tables.to(
            source.device if device is None else device, dtype or torch.get_default_dtype()
        )

    def forward(
        self, image: Shaped[Tensor, "*images c h w"], mask: Shaped[Tensor, "*masks h w"] | None = None
    ) -> Shaped[Tensor, "*batch c rows columns"]:
        """The image ``(*b, c, h, w)`` in the target camera, ``(*b, c, h', w')``.

        Args:
            image: as taken by the source.
            mask: ``(*b, h, w)``, usable pixels of this image; with a mask of the module, those in both.

        Raises:
            ShapeError: image or mask are not of the source's size.
            ArgumentError: integers in another mode than ``"nearest"``.
        """
        check_image("image", image, self.tables.source_shape)
        result: Tensor = self.tables(image, mask)
        return result


def remap_tables(
    source: Camera,
    target: Camera,
    rotation: Float[Tensor, "*turns 3 3"] | None,
    mode: str,
    fill: float,
    mask: Shaped[Tensor, "*masks h w"] | None,
    device: torch.device | str,
) -> MaskedLookup:
    """Where every target pixel is looked up; gradients reach rotation and intrinsics through it."""
    check_choice("mode", mode, REMAP_MODES)
    check_type("source", source, Camera)
    check_type("target", target, Camera)
    check_type("fill", fill, (int, float))
    if rotation is not None:
        check_rotation("rotation", rotation)
    if mask is not None:
        check_tensor("mask", mask, "(*b, h, w)")
    # In double precision, so that values, masks and modules agree about what lies on a border.
    dtype = torch.float32 if torch.device(device).type == "mps" else torch.float64
    size, edges = source.image_size, source.edges
    centers = target.pixel_grid(dtype).to(device)
    pixels, valid = source_pixels(source, target, rotation, centers)
    flat_pixels, flat_valid = pixels.flatten(-3, -2).unsqueeze(-2), valid.flatten(-2).unsqueeze(-1)
    groups = cell_groups(footprint(pixels, valid, source).flatten(0, 1), size) if mode == "area" else []
    averages = any(group.level or group.samples != (1, 1) for group in groups)
    if mode == "nearest":
        positions = torch.where(valid.unsqueeze(-1), pixels, 0.0)
        lookup: nn.Module = Lookup(nearest_pixel(source, positions).flatten(-2), dims=2)
    elif averages:

        def group_lookup(group: CellGroup) -> nn.Module:
            samples = pixel_samples(target, group.cells, group.samples, dtype)
            return lookup_at_level(
                *source_pixels(source, target, rotation, samples), size, group.level, edges
            )

        lookup = PyramidLookup(groups, group_lookup)
    else:
        lookup = image_lookup(flat_pixels, flat_valid, size, edges=edges, cubic=mode == "bicubic")
    tables = _InverseLookup if mode == "depth" else MaskedLookup
    usable = None if mask is None else mask.to(device)
    # Where samples are averaged, what counts is whether enough of them see something.
    centers_valid = None if averages else valid.flatten(-2)
    return tables(lookup, size, target.image_size, mode, fill, centers_valid, usable, not averages)


class _InverseLookup(MaskedLookup):
    """Depth along rays: its inverse is interpolated, and what is not positive is not known."""

    def forward(self, values: Tensor, mask: Tensor | None = None) -> Tensor:
        if not values.is_floating_point():
            return super().forward(values, mask)  # which says what is wrong
        valid_depth = (values > 0).all(-3)
        inverse = 1 / torch.where(values > 0, values, 1.0).to(
            torch.promote_types(values.dtype, torch.float32)
        )
        mean, valid = self.means(inverse, valid_depth if mask is None else valid_depth & self._checked(mask))
        positive = mean > 0
        far = torch.full_like(mean[..., :1, :], torch.inf)
        if valid is not None:
            far = torch.where(valid.unsqueeze(-2), far, self.fill)
        depth = torch.where(positive, 1 / torch.where(positive, mean, 1.0), far)
        return depth.to(values.dtype).unflatten(-1, self.target_shape)
