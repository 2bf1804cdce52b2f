# SPDX-License-Identifier: Apache-2.0
"""Resampling between any two grids or cameras, with a rotation in between."""

from __future__ import annotations

import copy

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, nn

from sphericalvision.cameras import Camera
from sphericalvision.geometry.masked_lookup import LookupModule
from sphericalvision.sphere.grids.sphere_grid import SphereGrid, check_values
from sphericalvision.sphere.resampling.resample_tables import resample_tables
from sphericalvision.sphere.resampling.supersampling import grid_shape


def resample(
    values: Shaped[Tensor, "*values"],
    source: SphereGrid | Camera,
    target: SphereGrid | Camera,
    rotation: Float[Tensor, "*turns 3 3"] | None = None,
    mode: str = "bilinear",
    fill: float = 0.0,
    mask: Shaped[Tensor, "*mask"] | None = None,
) -> Shaped[Tensor, "*results"]:
    """Resample values from one grid or camera to another.

    Depth along the rays needs no correction, since all grids and cameras have the same centre. For many values on one
    pair ``Resample`` is faster: it computes the lookup table once.

    Args:
        values: ``(*b, c, *source_shape)``; the shape of a camera is its ``image_size``.
        source: where the values are given.
        target: where they are wanted.
        rotation: ``(3, 3)``, or ``(*b, 3, 3)`` for one a sample, target_from_source: what was seen in direction d is
            then seen in ``rotation @ d``.
        mode: ``"bilinear"`` interpolates between the nearest values (linear in each triangle of an icosphere), and
            aliases where the target is coarser. ``"area"`` is the mean over each cell of the target where the target
            is coarser, and bilinear elsewhere. ``"nearest"`` creates no new values: for labels, of any dtype. It takes
            the value whose cell contains the direction, see ``SphereGrid.nearest``.
        fill: value where the source or the target does not see, see ``resample_mask``.
        mask: ``(*b, *source_shape)``, values that may be used (bool, or nonzero). Results are means over usable values.

    Returns:
        ``(*b, c, *target_shape)`` of the values' dtype; differentiable in values and, except for ``"nearest"``,
        in the rotation and a camera's intrinsics.

    Raises:
        ShapeError: if values or mask do not lie on the source, or the rotation is no 3 x 3 matrix.
        ArgumentError: if source or target is neither a grid nor a camera, the mode is unknown, or integers are to be
            interpolated.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> from sphericalvision.sphere import Equirectangular
        >>> ico = Icosphere(4)
        >>> height = resample(-ico.vertices[None, :, 1], ico, Equirectangular(8, 16))
        >>> height.shape, bool(height[0, 0].min() > 0.97)
        (torch.Size([1, 8, 16]), True)
    """
    check_values(values, grid_shape(source, "source"))
    tables = resample_tables(source, target, rotation, mode, fill, mask, values.device, values.dtype)
    result: Tensor = tables(values)
    return result


@torch.no_grad()
def resample_mask(
    source: SphereGrid | Camera,
    target: SphereGrid | Camera,
    rotation: Float[Tensor, "*turns 3 3"] | None = None,
    mode: str = "bilinear",
    mask: Shaped[Tensor, "*mask"] | None = None,
) -> Bool[Tensor, "*results"]:
    """Return where ``resample`` finds values, bool ``(*b, *target_shape)``: all but what a camera cannot see, and what
    depends on masked values alone.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> from sphericalvision.sphere import Equirectangular
        >>> resample_mask(Icosphere(2), Equirectangular(8, 16)).all()
        tensor(True)
    """
    device = next((t.device for t in (mask, rotation) if t is not None), _like(source).device)
    return resample_tables(source, target, rotation, mode, 0.0, mask, device).mask()


class Resample(LookupModule):
    """``resample`` between two fixed grids or cameras, with tables that are computed once.

    The tables are buffers that move with the module and are not saved. They have no gradients with respect to rotation
    or intrinsics; use ``resample`` for these. ``mask()`` returns where results are valid.

    Arguments are those of ``resample``, ``mask`` being that of every call, and these:

    Args:
        dtype: of the tables; by default that of the grids' directions and the cameras' intrinsics.
        device: of the tables; by default the source's.

    Examples:
        >>> from sphericalvision.sphere import Cubemap, Equirectangular
        >>> to_cube = Resample(Equirectangular(32, 64), Cubemap(16), mode="area")
        >>> to_cube
        Resample((32, 64) -> (6, 16, 16), mode='area')
        >>> to_cube(torch.rand(2, 3, 32, 64)).shape
        torch.Size([2, 3, 6, 16, 16])
    """

    @torch.no_grad()
    def __init__(
        self,
        source: SphereGrid | Camera,
        target: SphereGrid | Camera,
        rotation: Float[Tensor, "*turns 3 3"] | None = None,
        mode: str = "bilinear",
        fill: float = 0.0,
        mask: Shaped[Tensor, "*mask"] | None = None,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        grid_shape(source, "source")
        grid_shape(target, "target")
        if isinstance(source, nn.Module):
            source = copy.deepcopy(source)  # its tables move with this module, the caller's stay
        device = _like(source).device if device is None else torch.device(device)
        if dtype is None:
            dtype = torch.promote_types(_like(source).dtype, _like(target).dtype)
        self.tables = resample_tables(source, target, rotation, mode, fill, mask, device, dtype).to(dtype)

    def forward(
        self, values: Shaped[Tensor, "*values"], mask: Shaped[Tensor, "*mask"] | None = None
    ) -> Shaped[Tensor, "*results"]:
        """Values ``(*b, c, *source_shape)`` on the target, ``(*b, c, *target_shape)``.

        Args:
            values: on the source.
            mask: ``(*b, *source_shape)``, which of these values may be used; with a mask of the module, those in both.
        """
        check_values(values, self.tables.source_shape)
        result: Tensor = self.tables(values, mask)
        return result


def _like(grid: SphereGrid | Camera) -> Tensor:
    """A tensor of the grid's dtype and on its device."""
    return grid.max_angle if isinstance(grid, Camera) else grid.directions
