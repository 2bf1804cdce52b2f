# SPDX-License-Identifier: Apache-2.0
"""Memory that lies ready between calls: on a CPU, pages fresh from the system cost as much as the sums done in them."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["Workspace", "workspace"]


class Workspace:
    """Buffers by name, kept from one convolution to the next."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, torch.dtype, torch.device], Tensor] = {}

    def take(self, name: str, shape: Sequence[int], like: Float[Tensor, " ..."]) -> Float[Tensor, " ..."]:
        """A tensor of that shape whose values are left from before; whoever asks for the name next overwrites it."""
        key, size = (name, like.dtype, like.device), math.prod(shape)
        kept = self._kept.get(key)
        if kept is None or kept.numel() < size:
            self._kept.pop(key, None)
            with torch.inference_mode(False):  # what inference makes could not be written to in training
                kept = self._kept[key] = torch.empty(size, dtype=like.dtype, device=like.device)
        return kept[:size].view(shape)


_of_thread = threading.local()


def workspace() -> Workspace:
    """The workspace of this thread. It is as large as the largest call so far needed, a few rectangles of volumes."""
    if not hasattr(_of_thread, "workspace"):
        _of_thread.workspace = Workspace()
    return _of_thread.workspace  # type: ignore[no-any-return]
