# SPDX-License-Identifier: Apache-2.0
"""Training of OmniMVS."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor

from sphericalvision.models import OmniMVS
from sphericalvision.recipes.training.lit_base import IndexModule

__all__ = ["OmniMVSModule"]


class OmniMVSModule(IndexModule):
    """OmniMVS with the Huber loss on the hypothesis index, Adam, and the paper's metrics on its panorama.

    Every argument is a plain value, so checkpoints load with ``weights_only=True`` and rebuild the network.

    Args:
        num_hypotheses: number of inverse-depth hypotheses N, even.
        min_depth: nearest hypothesis in metres.
        feature_channels: width C of the features.
        num_cameras: number of cameras of the rig.
        output_size: (height, width) of the panorama.
        in_channels: 1 for grey images, 3 for colour.
        norm: "batch", or "instance" for batches of one or two.
        aggregation: "concatenation", or "variance" for any number of cameras and few training frames.
        circular: whether the panorama's convolutions continue at the other edge.
        num_scales: how often the encoder halves the volume.
        recompute: train in less memory, for a third more work; the results are the same.
        learning_rate: of Adam, at its highest.
        weight_decay: of Adam.
        schedule: ``"constant"``, ``"step"`` or ``"cosine"``; see ``learning_rate_factor``.
        schedule_steps: iteration at which a cosine ends.
        warmup_steps: iterations of linear rise.
        decay_after: iteration at which a step schedule drops.
        decay_factor: factor of that drop, or of the cosine's end.
        huber_delta: where the loss turns from quadratic to linear, in hypothesis indices.
        seed: with the iteration's number it seeds each training step, so that resuming changes nothing.
    """

    images_entry, truth_entry, valid_entry = "fisheye", "panorama_inverse_depth", "panorama_valid"
    data_hint = "take data=fisheye_scenes with the entries fisheye and panorama"

    def __init__(
        self,
        num_hypotheses: int = 192,
        min_depth: float = 0.55,
        feature_channels: int = 32,
        num_cameras: int = 4,
        output_size: Sequence[int] = (160, 640),
        in_channels: int = 1,
        norm: str = "batch",
        aggregation: str = "concatenation",
        circular: bool = False,
        num_scales: int = 4,
        recompute: bool = False,
        learning_rate: float = 1e-3,
        weight_decay: float = 0.0,
        schedule: str = "step",
        schedule_steps: int = 54_000,
        warmup_steps: int = 0,
        decay_after: int = 36_000,
        decay_factor: float = 0.1,
        huber_delta: float = 1.0,
        seed: int = 0,
    ) -> None:
        output_size = list(output_size)
        net = OmniMVS(
            num_hypotheses,
            min_depth,
            feature_channels,
            num_cameras,
            output_size,
            in_channels,
            norm,
            aggregation,
            circular,
            num_scales,
        )
        net.configure(recompute=recompute)
        super().__init__(net, schedule, schedule_steps)
        self.save_hyperparameters()

    def on_grid(self, values: Tensor) -> Tensor:
        """The rows of a panorama ``(B, H, W)`` that the network estimates."""
        return self.net.grid.rows_of(values)

    def panorama(self, values: Tensor, height: int) -> Tensor:
        """Values ``(h, w)`` of a frame, each pixel as large as makes about ``height`` rows."""
        return F.interpolate(values[None, None], scale_factor=max(1, round(height / len(values))))[0, 0]
