# SPDX-License-Identifier: Apache-2.0
"""Which checkpoint of a training is the best."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import pytorch_lightning as pl
from pytorch_lightning.callbacks import ModelCheckpoint

from sphericalvision.io.files import atomic_write
from sphericalvision.recipes.datamodules.base import SampleDataModule
from sphericalvision.recipes.training.module import TrainingModule

__all__ = ["best_checkpoint"]


def best_checkpoint(trainer: pl.Trainer, module: TrainingModule, data: SampleDataModule, last: Path) -> Path:
    """Return the best checkpoint of a training that has ended; the last state counts, too.

    Where the number of steps is no multiple of ``trainer.val_check_interval``, the last state has not been validated
    yet. It is now, and takes the place of the best one if it is better.

    Args:
        trainer: after ``fit``.
        module: what was trained.
        data: with the validation samples.
        last: the checkpoint of the last state.
    """
    keeper = trainer.checkpoint_callback
    if not isinstance(keeper, ModelCheckpoint) or not keeper.best_model_path:
        return last
    best = Path(keeper.best_model_path)
    if keeper.best_model_score is None or module.validated_step == trainer.global_step:
        return best
    trainer.validate(module, data, ckpt_path=last, weights_only=True, verbose=False)
    score, former = float(trainer.callback_metrics[module.monitor]), float(keeper.best_model_score)
    better = score < former if module.mode == "min" else score > former
    if trainer.is_global_zero and (better or math.isnan(former)):
        for suffix in (".ckpt", ".safetensors"):
            if last.with_suffix(suffix).is_file():
                with atomic_write(best.with_suffix(suffix)) as temporary:
                    shutil.copyfile(last.with_suffix(suffix), temporary)
    trainer.strategy.barrier()
    return best
