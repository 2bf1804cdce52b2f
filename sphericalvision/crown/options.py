# SPDX-License-Identifier: Apache-2.0
"""How the layers inside a network are computed: choices of time and memory that change no result."""

from __future__ import annotations

from torch import nn

from sphericalvision.core import ArgumentError
from sphericalvision.crown import fast

__all__ = ["kernel_option", "native_pays_at_once", "set_kernel_options"]


def set_kernel_options(
    module: nn.Module, *, native: bool | None = None, recompute: bool | None = None
) -> None:
    """Choose how the layers inside a network are computed, at any time; the results stay the same.

    Layers that offer a choice have an attribute of its name.

    Args:
        module: the network, or a part of it.
        native: whether convolutions of stride 1 and the normalisations after them use operators in C++, which is faster
            on a CPU, in training and inference; compiled and exported graphs do without. The operators are compiled
            when they are first asked for on a machine. None keeps what was chosen.
        recompute: whether training saves memory by computing the inside of blocks twice, for a third more work. None
            keeps what was chosen.

    Raises:
        ArgumentError: if no layer offers a choice that is asked for.
        MissingCompilerError: with ``native``, if the operators could not be compiled; nothing has changed then.

    Examples:
        >>> from sphericalvision.crown import CrownBlock3d
        >>> block = CrownBlock3d(2, 2, 2)
        >>> set_kernel_options(block, recompute=True)
        >>> kernel_option(block, "recompute"), kernel_option(block, "native")
        (True, False)
    """
    chosen = {
        name: value for name, value in (("native", native), ("recompute", recompute)) if value is not None
    }
    for name, value in chosen.items():
        if value and not _parts(module, name):
            raise ArgumentError(f"{name}: {type(module).__name__} has nothing to choose there; leave it out")
    if native:
        fast.native_operators()
    for name, value in chosen.items():
        for part in _parts(module, name):
            setattr(part, name, value)


def kernel_option(module: nn.Module, name: str) -> bool:
    """Return whether a choice of ``set_kernel_options`` is on anywhere inside a network."""
    return any(getattr(part, name) for part in _parts(module, name))


def native_pays_at_once(module: nn.Module) -> bool:
    """Return whether a network has layers that operators in C++ make faster, and these have been compiled here.

    Examples:
        >>> native_pays_at_once(nn.Linear(1, 1))
        False
    """
    return bool(_parts(module, "native")) and fast.native_at_hand()


def _parts(module: nn.Module, name: str) -> list[nn.Module]:
    """Layers with that attribute, which is one of the instance or a default of the class."""
    return [
        part
        for part in module.modules()
        if name in vars(part) or isinstance(getattr(type(part), name, None), bool)
    ]
