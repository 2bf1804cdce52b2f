# SPDX-License-Identifier: Apache-2.0
"""Adapting a depth network to a capture without truth: judged by photo-consistency, kept only where that rises."""

from pathlib import Path
from typing import Any

from torch import Tensor
from torchmetrics import MeanMetric

from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.models import save_weights
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.recipes.datamodules.capture import CaptureDataModule
from sphericalvision.recipes.training.depth_module import DepthModule
from sphericalvision.sweep.consistency_share import consistency_share

RESULT = "adapted.safetensors"


class AdaptModule(DepthModule):
    """``DepthModule`` for captures: validated is the photo-consistency of frames that were held out.

    All weights learn, those of the prior of a ``RefinedSweepNet``, too.

    At the end ``adapted.safetensors`` in the folder of the run holds the best weights if they are more
    photo-consistent than those that training started from, and these if not.
    """

    metric_names = ("photo-consistency",)
    unit = "share of what winner-takes-all reaches"
    learns_all = True

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, hints=0.0, **settings)  # there is no truth that they could be made from
        self.share = MeanMetric("disable")  # a number that is none shows

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """Gather the photo-consistency of one batch; returns the index."""
        index = self.estimate(batch)
        correlation = batch["correlation"].float() / 255
        vertices = Icosphere(level_from_num_vertices(correlation.shape[-1]), device=index.device).vertices
        position = self.net.index_at(index, vertices)[0] / (self.net.num_hypotheses - 1)
        self.share.update(consistency_share(position, correlation, batch["correlation_seen"]))
        return index

    def on_validation_epoch_end(self) -> None:
        """Log ``val/photo-consistency``."""
        self.log("val/photo-consistency", self.share.compute(), prog_bar=True, sync_dist=True)
        self.share.reset()

    def write_report(
        self, data: Any, values: dict[str, float], init_weights: str | None, folder: Path
    ) -> None:
        """Compare the best checkpoint with the start, and write the weights to use."""
        assert isinstance(data, CaptureDataModule)
        before, after = data.start_share, values["photo-consistency"]
        path = folder / RESULT
        print(
            f"photo-consistency of {len(data.held_out)} held-out frame(s): {before:.4f} before, {after:.4f} after "
            f"({after - before:+.4f})"
        )
        if after > before:
            save_weights(self.net, path)
        else:
            print("It has not risen: the old weights stay.")
            start = self.net if init_weights is None else read_network(init_weights)
            save_weights(start, path)
        print(f"Weights to use: checkpoint={path}")
