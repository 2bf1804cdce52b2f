# SPDX-License-Identifier: Apache-2.0
"""``SphereGrid``: the interface of all grids of directions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, ShapeError, check_floating, check_tensor, check_type
from sphericalvision.geometry import bilinear_sample

MAX_CELLS = 2**27
"""The largest grid: a panorama of 8192 x 16384 pixels, whose directions take 1.5 GB in float32."""


def check_cells(count: int, **sizes: int) -> None:
    """Raise ``ArgumentError`` unless a grid of these sizes has no more than ``MAX_CELLS`` values.

    Examples:
        >>> check_cells(4 * 8, height=4, width=8)
    """
    if count > MAX_CELLS:
        numbers = ", ".join(map(str, sizes.values()))
        raise ArgumentError(
            f"{', '.join(sizes)}: expected a grid of {MAX_CELLS:,} values at most (8192 x 16384), got {numbers}, "
            f"which makes {count:,}; take a smaller one"
        )


def check_values(values: Shaped[Tensor, " ..."], shape: Sequence[int]) -> None:
    """Raise ``ShapeError`` unless ``values`` is ``(*b, c, *shape)``.

    Examples:
        >>> import torch
        >>> check_values(torch.zeros(3, 4, 8), (4, 8))
    """
    expected = f"(*b, c, {', '.join(map(str, shape))})"
    check_tensor("values", values, expected)
    if values.ndim <= len(shape) or tuple(values.shape[-len(shape) :]) != tuple(shape):
        raise ShapeError(f"values: expected shape {expected}, got {tuple(values.shape)}")


@runtime_checkable
class SphereGrid(Protocol):
    """A grid of directions that covers the sphere or a part of it, with values interpolated between them.

    ``Equirectangular``, ``Cubemap``, ``Healpix``, ``Icosphere`` and ``TangentImages`` are such grids; a class with
    these members is one too, without inheriting.

    ``resample`` uses more of a grid that has it: ``image`` and ``image_pixels`` (values as an image in which to
    interpolate, and ``image_edges`` if it continues beyond its edges) or ``locate`` (ids and weights) to make tables
    once, ``cell_samples`` to average over cells, and ``cell_widths`` if the spacing of values does not follow from
    solid angles. A grid that does not cover the sphere has ``contains(directions)``.

    Examples:
        >>> from sphericalvision.icosphere import Icosphere
        >>> isinstance(Icosphere(1), SphereGrid)
        True
    """

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of values on the grid, without batch and channels."""

    @property
    def directions(self) -> Float[Tensor, "*grid 3"]:
        """Unit directions ``(*shape, 3)`` at which values are given; x right, y down, z forward."""

    @property
    def solid_angles(self) -> Float[Tensor, "*grid"]:
        """Solid angles ``(*shape)`` in steradians, which sum to 4π where the grid covers the sphere."""

    def sample(
        self, values: Float[Tensor, "*values"], directions: Float[Tensor, "*points 3"]
    ) -> Float[Tensor, "*results"]:
        """Interpolate ``(*b, c, *shape)`` at ``(*b, n, 3)`` or ``(n, 3)``, giving ``(*b, c, n)``; NaN at NaN."""

    def nearest(self, directions: Float[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """Return the index ``(*)``, into the flattened grid, of the value in whose cell ``(*, 3)`` lies.

        That is the value nearest by angle on an icosphere. Pixels of a panorama, a cube map, HEALPix or a tangent image
        are no Voronoi cells: near their edges another centre may be closer, by less than a pixel. A NaN is refused.
        """


class GridModule(nn.Module):
    """Base of the grids of this package; their tables move with ``.to`` and are not saved."""

    directions: Tensor

    def _make_directions(self: Any, dtype: torch.dtype | None, device: torch.device | str | None) -> None:
        """Register the cells' centres, computed in float64, as the buffer ``directions`` in ``dtype``."""
        if dtype is not None:
            size = "×".join(map(str, self.shape))
            check_type("dtype", dtype, torch.dtype, f"this grid is {size}, and a further size is not taken")
        directions = self.cell_samples(1, torch.float64, device)[0].view(*self.shape, 3)
        self.register_buffer(
            "directions", directions.to(dtype or torch.get_default_dtype()), persistent=False
        )

    def sample(
        self: Any, values: Float[Tensor, " ..."], directions: Float[Tensor, "*places n 3"]
    ) -> Float[Tensor, "*batch c n"]:
        """Interpolate values linearly between those around each direction, as the class describes.

        Args:
            values: ``(*b, c, *shape)``, floating point.
            directions: ``(*b, n, 3)``, or ``(n, 3)`` for all of the batch.

        Returns:
            ``(*b, c, n)``, differentiable in both arguments; NaN where a direction is.
        """
        check_values(values, self.shape)
        check_floating("values", values)
        result: Tensor = self._interpolated(values, directions)
        return result

    def _interpolated(self: Any, values: Tensor, directions: Tensor) -> Tensor:
        return bilinear_sample(self.image(values), self.image_pixels(directions))
