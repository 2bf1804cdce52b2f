# SPDX-License-Identifier: Apache-2.0
"""Lookups with a mask of usable values and a value for results without any, and the module around them."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.geometry.directions import in_single_precision
from sphericalvision.geometry.lookup import Lookup, PlacesInSinglePrecision

_TOUCHED = 1e-3  # the least share of usable values in what a result is made of


class MaskedLookup(PlacesInSinglePrecision):
    """Means over the usable values that a lookup finds, ``fill`` where it finds too few.

    Args:
        lookup: ``Lookup``, ``ImageLookup`` or any module that maps values (*b, C, *source_shape) to (*b, C, P), zero
            where nothing is seen.
        source_shape: of values.
        target_shape: of results, P in all.
        mode: how values are read, for error messages.
        fill: value where nothing is found.
        valid: ``(*g, P)`` where something is seen; everywhere if not given.
        usable: ``(*b, *source_shape)``, values that may be used; all if not given.
        whole: True if the weights of what is seen sum to one already, so that no normalisation is needed.
    """

    valid: Tensor | None
    usable: Tensor | None
    gain: Tensor | None

    def __init__(
        self,
        lookup: nn.Module,
        source_shape: tuple[int, ...],
        target_shape: tuple[int, ...],
        mode: str,
        fill: float = 0.0,
        valid: Bool[Tensor, "*g P"] | None = None,
        usable: Shaped[Tensor, " ..."] | None = None,
        whole: bool = True,
    ) -> None:
        super().__init__()
        self.lookup, self.mode, self.fill = lookup, mode, fill
        self.source_shape, self.target_shape = source_shape, target_shape
        self.picks = isinstance(lookup, Lookup) and lookup.weights is None
        self.register_buffer("valid", valid, persistent=False)
        self.register_buffer("usable", None, persistent=False)
        gain = None
        if usable is not None or not whole:
            everywhere = torch.ones(source_shape, dtype=torch.bool, device=next(lookup.buffers()).device)
            mask = everywhere if usable is None else self._checked(usable)
            self.usable = None if usable is None else mask
            gain, self.valid = self._weigh(mask, next(self.lookup.buffers()).dtype)
        self.register_buffer("gain", gain, persistent=False)
        if self.valid is not None and self.valid.device.type != "meta" and bool(self.valid.all()):
            self.valid = None

    def forward(
        self, values: Shaped[Tensor, " ..."], mask: Shaped[Tensor, " ..."] | None = None
    ) -> Shaped[Tensor, " ..."]:
        """``values`` (*b, C, *source_shape) on the target, (*b, C, *target_shape), of their dtype."""
        if not values.is_floating_point() and self.mode != "nearest":
            raise ArgumentError(
                f"values: expected floating point numbers for mode {self.mode!r}, got {values.dtype}; convert them, "
                "or use mode 'nearest' for labels"
            )
        if self.picks:
            self._check_fill(values)
            result, valid = self.lookup(values), self._valid(mask)
            if valid is not None:
                result = torch.where(
                    valid.unsqueeze(-2), result, torch.full_like(result[..., :1, :1], self.fill)
                )
            return result.unflatten(-1, self.target_shape)  # type: ignore[no-any-return]
        result, valid = self.means(in_single_precision(values), mask)
        if valid is not None and self.fill != 0:
            # Zeros stand there: a sum is faster than a choice in all channels.
            result = result + torch.where(valid, 0.0, self.fill).to(result.dtype).unsqueeze(-2)
        return result.to(values.dtype).unflatten(-1, self.target_shape)

    def means(
        self, values: Float[Tensor, " ..."], mask: Shaped[Tensor, " ..."] | None = None
    ) -> tuple[Float[Tensor, "*batch C P"], Bool[Tensor, "*seen P"] | None]:
        """Means (*b, C, P) over usable ones of ``values`` (*b, C, *source_shape), zero where not valid, and where."""
        gain, valid, usable = self.gain, self.valid, self.usable
        if mask is not None:
            usable = self._checked(mask)
            gain, valid = self._weigh(usable, values.dtype)
        if usable is not None:
            values = torch.where(usable.unsqueeze(-len(self.source_shape) - 1), values, 0.0)
        result: Tensor = self.lookup(values)
        return result if gain is None else result * gain.to(result.dtype).unsqueeze(-2), valid

    def mask(self, mask: Shaped[Tensor, " ..."] | None = None) -> Bool[Tensor, " ..."]:
        """Where results are valid, bool ``(*b, *target_shape)``, given the values that may be used."""
        valid = self._valid(mask)
        if valid is None:
            device = next(self.lookup.buffers()).device
            return torch.ones(self.target_shape, dtype=torch.bool, device=device)
        return valid.unflatten(-1, self.target_shape)

    def _valid(self, mask: Tensor | None) -> Tensor | None:
        return self.valid if mask is None else self._weigh(self._checked(mask), torch.float32)[1]

    def _weigh(self, usable: Tensor, dtype: torch.dtype) -> tuple[Tensor | None, Tensor]:
        """One over the weight of usable values in each result (*b, P), and where there is enough of it."""
        usable = usable.unsqueeze(-len(self.source_shape) - 1)
        gain = None
        if self.picks:
            touched = self.lookup(usable).squeeze(-2)
        else:
            weight = self.lookup(usable.to(dtype if dtype.is_floating_point else torch.float64)).squeeze(-2)
            touched = weight > _TOUCHED
            gain = torch.where(touched, 1 / torch.where(touched, weight, 1.0), 0.0)
        return gain, touched if self.valid is None else touched & self.valid

    def _checked(self, mask: Tensor) -> Tensor:
        check_mask(mask, self.source_shape)
        if self.mode == "bicubic":
            raise ArgumentError(
                "mask: a bicubic kernel has negative weights; use 'bilinear' or 'area' with a mask"
            )
        return mask != 0 if self.usable is None else (mask != 0) & self.usable

    def _check_fill(self, values: Tensor) -> None:
        if values.is_floating_point():
            return
        info = None if values.dtype == torch.bool else torch.iinfo(values.dtype)
        least, most = (0, 1) if info is None else (info.min, info.max)
        if not (least <= self.fill <= most and self.fill == int(self.fill)):
            raise ArgumentError(f"fill: expected a value that {values.dtype} can hold, got {self.fill}")


def check_mask(mask: Shaped[Tensor, " ..."], source_shape: tuple[int, ...]) -> None:
    """Raise ``ShapeError`` unless a mask lies on the source ``(*b, *source_shape)``."""
    if tuple(mask.shape[max(0, mask.ndim - len(source_shape)) :]) != source_shape:
        size = ", ".join(map(str, source_shape))
        raise ShapeError(f"mask: expected shape (*b, {size}) as the source, got {tuple(mask.shape)}")


class LookupModule(nn.Module):
    """A module of images with ``tables``."""

    tables: MaskedLookup

    def mask(self, mask: Shaped[Tensor, " ..."] | None = None) -> Bool[Tensor, " ..."]:
        """Where results are valid, bool ``(*b, *target_shape)``; ``mask`` as in ``forward``."""
        return self.tables.mask(mask)

    def __repr__(self) -> str:
        tables = self.tables
        return f"{type(self).__name__}({tables.source_shape} -> {tables.target_shape}, mode={tables.mode!r})"
