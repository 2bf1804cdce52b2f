# SPDX-License-Identifier: Apache-2.0
"""Train a network: ``sphericalvision-train experiment=quickstart`` (depth), ``experiment=spherical_digits``.

Everything goes to one folder: the resolved config, checkpoints with the weights beside them, metrics (CSV and
TensorBoard), depth panels and the final table.
"""

from __future__ import annotations

import logging
import sys
import warnings
from pathlib import Path
from typing import NamedTuple

import pytorch_lightning as pl
from omegaconf import DictConfig
from pytorch_lightning.loggers import CSVLogger, TensorBoardLogger

from sphericalvision.core import ArgumentError, check_file
from sphericalvision.recipes.app.cli import build, print_config
from sphericalvision.recipes.app.next_steps import evaluate_command, resume_command
from sphericalvision.recipes.datamodules.base import SampleDataModule
from sphericalvision.recipes.digits.module import ClassificationModule
from sphericalvision.recipes.evaluation.tables import Row, print_rows, save_rows
from sphericalvision.recipes.training.callbacks import training_callbacks
from sphericalvision.recipes.training.checkpoint_io import WeightsBesideCheckpoint
from sphericalvision.recipes.training.lit_base import IndexModule

__all__ = ["Run", "instantiate_run", "train"]


class Run(NamedTuple):
    """The objects of a training run."""

    module: IndexModule | ClassificationModule
    data: SampleDataModule
    trainer: pl.Trainer


def instantiate_run(config: DictConfig, folder: Path) -> Run:
    """Make network, data and trainer of a config; results go to ``folder``."""
    pl.seed_everything(config.seed, workers=True, verbose=False)
    module = build(config.model, **config.optimizer, seed=config.seed)
    data = build(config.data)
    panel_frames = config.panel_frames if isinstance(module, IndexModule) else 0
    trainer = build(
        config.trainer,
        default_root_dir=str(folder),
        callbacks=training_callbacks(folder, config.checkpoint_minutes, panel_frames, module.monitor),
        logger=[
            CSVLogger(str(folder), name="metrics", flush_logs_every_n_steps=20),
            TensorBoardLogger(str(folder), name="", version="tensorboard", default_hp_metric=False),
        ],
        plugins=[WeightsBesideCheckpoint(module.net)],
        enable_progress_bar=sys.stdout.isatty(),
    )
    return Run(module, data, trainer)


def resume_path(resume: str | None, folder: Path) -> Path | None:
    """The checkpoint to resume from: ``auto`` is this folder's last one, if there is any."""
    if resume is None:
        return None
    if resume == "auto":
        last = folder / "checkpoints" / "last.ckpt"
        return last if last.is_file() else None
    return check_file(resume, "a Lightning checkpoint to resume from, such as checkpoints/last.ckpt")


def check_resume(path: Path | None, module: IndexModule | ClassificationModule) -> None:
    """Refuse to resume a network of another shape or scale; its step count would mean nothing here.

    Raises:
        ArgumentError: the first hyper-parameter that differs, with both values.
    """
    if path is None:
        return
    network = module.stored_network(path)
    if type(network) is not type(module.net):
        raise ArgumentError(
            f"resume: {path} is a training of {type(network).__name__}, this run trains {type(module.net).__name__}"
        )
    stored = network.hyperparameters
    for key, value in module.net.hyperparameters.items():
        if stored[key] != value:
            raise ArgumentError(
                f"resume: {path} was trained with {key} = {stored[key]}, this run has model.{key} = {value}; "
                f"set model.{key}={stored[key]} to go on, or start anew from it with init_weights={path}"
            )


def train(config: DictConfig, folder: Path) -> dict[str, float]:
    """Train as ``config`` says and return the validation metrics of the best checkpoint."""
    for known in (
        ".*exists and is not empty.*",
        ".*not resumable.*",
        ".*many workers.*",
        ".*LeafSpec.*",
        ".*logging interval.*",
    ):
        warnings.filterwarnings("ignore", known)
    logging.getLogger("pytorch_lightning").setLevel(logging.WARNING)
    print_config(config, folder)
    module, data, trainer = instantiate_run(config, folder)
    checkpoint = resume_path(config.resume, folder)
    check_resume(checkpoint, module)
    if config.init_weights is not None and checkpoint is None:
        module.initialize(config.init_weights)
    last = folder / "checkpoints" / "last.ckpt"
    try:
        trainer.fit(module, data, ckpt_path=checkpoint, weights_only=True)
    except SystemExit:  # what Lightning makes of Ctrl+C
        if trainer.is_global_zero and last.is_file():
            print(f"\nStopped at step {trainer.global_step}. Go on with:\n{resume_command(last)}")
        raise
    trainer.save_checkpoint(last)
    best = Path(trainer.checkpoint_callback.best_model_path or last)  # type: ignore[union-attr]
    trainer.validate(module, data, ckpt_path=best, weights_only=True, verbose=False)
    values = logged_values(trainer, module, "val")
    report(f"validation ({module.unit})", folder / "validation", trainer, values)
    if isinstance(module, ClassificationModule):
        trainer.test(module, data, ckpt_path=best, weights_only=True, verbose=False)
        report(f"test ({module.unit})", folder / "test", trainer, logged_values(trainer, module, "test"))
    if trainer.is_global_zero:
        print(f"\nResults are in {folder}")
        print(f"Resume:   {resume_command(last, 2 * trainer.global_step)}")
        if isinstance(module, IndexModule):
            print(f"Evaluate: {evaluate_command(best, config)}")
    return values


def logged_values(
    trainer: pl.Trainer, module: IndexModule | ClassificationModule, split: str
) -> dict[str, float]:
    """The metrics of the last validation ("val") or test ("test"), by name."""
    keys = {name: f"{split}/{name.replace('>', 'over_')}" for name in module.metric_names}
    return {name: float(trainer.callback_metrics[key]) for name, key in keys.items()}


def report(title: str, stem: Path, trainer: pl.Trainer, values: dict[str, float]) -> None:
    """Print the best checkpoint's metrics and save them beside the run."""
    if trainer.is_global_zero:
        rows = [Row(f"step {trainer.global_step}, best checkpoint", values)]
        print_rows(title, rows)
        save_rows(stem, rows)
