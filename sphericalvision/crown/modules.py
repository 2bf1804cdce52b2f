# SPDX-License-Identifier: Apache-2.0
"""Modules that let ``torch.nn.Sequential`` go from values to crowns, through any layer at single places, and back."""

from __future__ import annotations

from jaxtyping import Float, Num
from torch import Tensor, nn

from sphericalvision.core import check_dtype
from sphericalvision.crown.layout import Crown, check_crown, crown_map, exchange, from_crown, to_crown


class ToCrown(nn.Module):
    """Lay values ``(B, C, V)`` or ``(B, C, N, V)`` out as a crown; see ``to_crown``.

    Examples:
        >>> import torch
        >>> from sphericalvision.crown import CrownConv2d
        >>> network = nn.Sequential(ToCrown(), CrownConv2d(3, 8), CrownPointwise(nn.GELU()), FromCrown())
        >>> network(torch.rand(2, 3, 162)).shape
        torch.Size([2, 8, 162])
    """

    def forward(self, values: Num[Tensor, "B C *N V"]) -> Crown:
        return to_crown(values)


class FromCrown(nn.Module):
    """Return the values of a crown, the mean over every place of a vertex; see ``from_crown``.

    Examples:
        >>> import torch
        >>> FromCrown()(ToCrown()(torch.ones(1, 1, 42))).shape
        torch.Size([1, 1, 42])
    """

    def forward(self, crown: Crown) -> Float[Tensor, "B C *N V"]:
        return from_crown(crown)


class CrownExchange(nn.Module):
    """Give every place of a vertex the mean over all its places; see ``exchange``.

    Examples:
        >>> import torch
        >>> CrownExchange()(ToCrown()(torch.ones(1, 1, 42))).level
        1
    """

    def forward(self, crown: Crown) -> Crown:
        return exchange(crown)


class CrownPointwise(nn.Module):
    """Apply a planar module that looks at single places to both kinds of rectangles of a crown.

    The module gets ``(5 * B, C, h, w)``, or ``(5 * B, C, N, h, w)`` from volumes: activations, dropout, ``nn.PReLU(C)``
    or an ``nn.Conv2d`` of size 1. What looks at neighbours would stop at the borders of the rectangles.

    Args:
        module: keeps all sizes but that of the channels.

    Examples:
        >>> import torch
        >>> crown = ToCrown()(torch.rand(2, 3, 42))
        >>> CrownPointwise(nn.Conv2d(3, 7, 1))(crown).row.shape
        torch.Size([2, 5, 7, 3, 5])
    """

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, crown: Crown) -> Crown:
        check_crown(crown)
        weight = next(self.module.parameters(), None)
        if weight is not None:
            check_dtype("crown", crown.col, weight)
        return crown_map(lambda x: self.module(x.flatten(0, 1)).unflatten(0, (-1, 5)), crown)
