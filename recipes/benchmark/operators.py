# SPDX-License-Identifier: Apache-2.0
"""Operators in C++ made ready before anything is measured, where there is a compiler."""

from __future__ import annotations

import torch

from sphericalvision.core import MissingCompilerError, kernels
from sphericalvision.crown import HexConv2d
from sphericalvision.recipes.app.cli import console

__all__ = ["have_operators"]


def have_operators(device: torch.device) -> None:
    """Wait for the operators, so that they are used from the first call on; say so where they cannot be had."""
    if device.type != "cpu":
        return
    try:
        with kernels("require"), torch.no_grad():
            HexConv2d(1, 1)(torch.zeros(1, 1, 12))
    except MissingCompilerError as error:
        console.print(f"measured without operators in C++: {error}")
