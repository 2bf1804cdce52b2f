# SPDX-License-Identifier: Apache-2.0
"""Checkpoints as Lightning writes them, and the network's weights alone beside each."""

from __future__ import annotations

import copy
import warnings
from pathlib import Path
from typing import Any

from pytorch_lightning.plugins.io import TorchCheckpointIO
from torch import nn

from sphericalvision.core import ArgumentError
from sphericalvision.io.files import atomic_write
from sphericalvision.models import DepthNetwork, save_weights
from sphericalvision.models.weights.registry import network_name

__all__ = ["WeightsBesideCheckpoint"]


class WeightsBesideCheckpoint(TorchCheckpointIO):
    """Lightning's checkpoints, and beside each ``.ckpt`` a depth network's weights alone as ``.safetensors``.

    Either file appears whole or not at all, so an interruption while saving leaves the previous ones.
    """

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net
        self._has_name = True
        if isinstance(net, DepthNetwork):
            try:
                network_name(net)
            except ArgumentError as error:
                warnings.warn(f"weights alone are not written: {error}", stacklevel=2)
                self._has_name = False

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None
    ) -> None:
        """Write both files."""
        path = Path(path)
        with atomic_write(path) as temporary:
            super().save_checkpoint(checkpoint, temporary, storage_options)
        if not isinstance(self.net, DepthNetwork) or not self._has_name:
            return
        net = self.net
        if (
            "current_model_state" in checkpoint
        ):  # of averaged weights, which are what was validated; the net has others
            net = copy.deepcopy(net)
            state = checkpoint["state_dict"].items()
            net.load_state_dict({name[4:]: value for name, value in state if name.startswith("net.")})
        save_weights(net, path.with_suffix(".safetensors"))

    def remove_checkpoint(self, path: Any) -> None:
        """Remove both files."""
        super().remove_checkpoint(path)
        Path(path).with_suffix(".safetensors").unlink(missing_ok=True)
