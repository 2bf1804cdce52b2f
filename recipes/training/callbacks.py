# SPDX-License-Identifier: Apache-2.0
"""Callbacks of training: pictures of the validation set, progress, and regular checkpoints."""

import signal
import sys
import threading
import time
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import Callback, RichProgressBar, WeightAveraging
from pytorch_lightning.loggers import TensorBoardLogger
from pytorch_lightning.utilities.exceptions import SIGTERMException

from sphericalvision.io.images import write_image
from sphericalvision.recipes.app.kinds import Count, Fraction, Number, Positive
from sphericalvision.sweep import depth_from_index, inverse_depth_from_index
from sphericalvision.viz.panorama import depth_to_color, error_to_color


class DepthPanels(Callback):
    """At each validation, write estimate, ground truth and error of the first frames, one above the other.

    Pictures go to ``folder`` and, if there is one, to the TensorBoard logger.

    Args:
        folder: where ``<step>.png`` is written.
        num_frames: frames of the first batch that are shown side by side.
        height: pixel rows of each panorama.
        max_error: percent of N at the bright end of the error's colours.
    """

    def __init__(
        self, folder: str | Path, num_frames: Number = 2, height: Count = 128, max_error: Positive = 10.0
    ) -> None:
        self.folder, self.num_frames = Path(folder), num_frames
        self.height, self.max_error = height, max_error

    def on_validation_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: Any,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Draw the first batch."""
        if batch_idx or dataloader_idx or trainer.sanity_checking or not trainer.is_global_zero:
            return
        if not (n := self.num_frames):
            return
        target, valid = pl_module.target(batch)
        panel = self.panel(pl_module, outputs[:n], target[:n], valid[:n])
        write_image(self.folder / f"{trainer.global_step:06d}.png", panel)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image("val/depth", panel, trainer.global_step, dataformats="HWC")

    def panel(self, module: Any, estimate: Any, target: Any, valid: Any) -> np.ndarray:
        """Estimate, ground truth and error of some frames as one picture."""
        number, nearest = module.net.num_hypotheses, module.net.min_depth
        columns = []
        for index, truth, mask in zip(estimate.float(), target.float(), valid, strict=True):
            truth = truth.where(mask, float("nan"))
            error = (index - truth).abs() * (100 / number)
            depths = [
                1 / module.panorama(inverse_depth_from_index(x, number, nearest), self.height)
                for x in (index, truth)
            ]
            farthest = float(depth_from_index(truth.new_zeros(()), number, nearest))
            rows = [depth_to_color(depth.cpu(), nearest, farthest) for depth in depths]
            rows.append(error_to_color(module.panorama(error, self.height).cpu(), self.max_error))
            columns.append(np.concatenate(rows, axis=0))
        return np.concatenate(columns, axis=1)


class MovingAverage(WeightAveraging):
    """Validated and kept is an exponential moving average of weights and running statistics.

    It lies where training runs, and a step of it is one operator for all weights, which nothing is read back for.
    Lightning's ``EMAWeightAveraging`` sends all weights to the host at each step, where a trainer first has them.
    """

    def __init__(self, decay: Fraction = 0.999) -> None:
        super().__init__()
        self.decay = decay

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Make the average where the weights will be."""
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:  # there is none but in training
            self._average_model.to(trainer.strategy.root_device)

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *args: Any) -> None:
        """Go towards the weights, once they have taken a step; after the first one, all the way."""
        if trainer.global_step == self._latest_update_step:  # gradients of several batches make a step
            return
        assert self._average_model is not None
        states = (module.state_dict().values() for module in (self._average_model.module, pl_module))
        pairs = list(zip(*states, strict=True))
        averages, values = map(
            list, zip(*(pair for pair in pairs if pair[0].is_floating_point()), strict=True)
        )
        torch._foreach_lerp_(averages, values, 1 - self.decay if self._latest_update_step else 1.0)
        for average, value in pairs:
            if not average.is_floating_point():  # how many batches a normalisation has met
                average.copy_(value)
        self._latest_update_step = trainer.global_step


class SaveOnInterrupt(Callback):
    """Write ``path`` when training is interrupted from the keyboard or by a job queue (SIGINT, SIGTERM).

    Of several processes a signal may reach one or all, each within another step. They agree before the next one, and
    stop there together: writing a checkpoint waits for all.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.asked = 0
        """The number of the signal that came; 0 for none."""
        self._handlers: dict[int, Any] = {}

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Only note signals, where several processes train."""
        # Lightning's handler of SIGTERM broadcasts at once, whatever its process exchanges just then: all wait forever.
        if trainer.world_size > 1 and threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(number, self._note)

    def _note(self, number: int, frame: Any) -> None:
        if self.asked and number == signal.SIGINT:  # whoever insists does not wait for the others
            raise KeyboardInterrupt
        self.asked = number

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Stop all processes if one was asked to."""
        if trainer.world_size == 1:
            return
        requested = torch.tensor(self.asked, device=trainer.strategy.root_device)
        number = int(trainer.strategy.reduce(requested, reduce_op="max"))
        if number == signal.SIGTERM:
            trainer._signal_connector.received_sigterm = True  # so that the exit status says so
            raise SIGTERMException
        if number:
            raise KeyboardInterrupt

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Give signals back to those who had them."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers.clear()

    def on_exception(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException
    ) -> None:
        """Save, unless nothing has been learned yet or the program is at fault."""
        if isinstance(exception, (KeyboardInterrupt, SIGTERMException)) and trainer.global_step:
            trainer.save_checkpoint(self.path)


class TrainingBar(RichProgressBar):
    """Lightning's bar without its count of epochs: training is counted in iterations.

    It shows the loss of every tenth: what is logged with ``prog_bar=True`` is read back from a device at each.
    """

    _loss: dict[str, float] = {}  # noqa: RUF012 (replaced, not changed)

    def get_metrics(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> dict[str, Any]:
        """Values of Lightning's bar, and the loss."""
        loss = trainer.callback_metrics.get("train/loss")
        if loss is not None and (not self._loss or trainer.global_step % 10 == 0):
            self._loss = {"train/loss": float(loss)}
        return {**super().get_metrics(trainer, pl_module), **self._loss}

    def _get_train_description(self, current_epoch: int) -> str:
        return "training"


class PlainProgress(Callback):
    """A line of progress every few seconds where no terminal can draw a bar (log files, job queues)."""

    def __init__(self, every_seconds: float = 15.0) -> None:
        self.every_seconds = every_seconds
        self.began = self.shown = self.ended = self.waited = 0.0
        self.first_step = 0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start the clock."""
        self.began = self.shown = self.ended = time.monotonic()
        self.first_step, self.waited = trainer.global_step, 0.0

    def on_train_batch_start(self, trainer: pl.Trainer, *args: Any) -> None:
        """Count how long the batch was waited for."""
        self.waited += time.monotonic() - self.ended

    def on_train_batch_end(self, trainer: pl.Trainer, *args: Any) -> None:
        """Say where training stands, if it is time."""
        now = self.ended = time.monotonic()
        if now - self.shown < self.every_seconds or not trainer.is_global_zero:
            return
        self.shown = now
        per_step = (now - self.began) / max(1, trainer.global_step - self.first_step)
        loss = trainer.callback_metrics.get("train/loss", float("nan"))
        remaining = ""
        if trainer.max_steps > 0:
            seconds = int(per_step * (trainer.max_steps - trainer.global_step))
            remaining = f" of {trainer.max_steps}, {timedelta(seconds=seconds)} left"
        print(
            f"step {trainer.global_step}{remaining}, {per_step:.2f} s a step, "
            f"{self.waited / (now - self.began):.0%} of it for samples, loss {float(loss):.3f}",
            flush=True,
        )

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Say how validation went."""
        if trainer.state.fn == "fit" and not trainer.sanity_checking and trainer.is_global_zero:
            values = ", ".join(
                f"{k} {float(v):.2f}" for k, v in trainer.callback_metrics.items() if "val/" in k
            )
            print(f"step {trainer.global_step} validation: {values}", flush=True)


def progress(every_seconds: Positive = 15.0) -> Callback:
    """A bar on a terminal, lines elsewhere."""
    return TrainingBar() if sys.stdout.isatty() else PlainProgress(every_seconds)
