# SPDX-License-Identifier: Apache-2.0
"""Train a network: what ``sphericalvision-train`` does.

Everything goes to one folder: the resolved config, checkpoints and their weights, metrics (CSV and
TensorBoard), depth panels and the final table.
"""

import logging
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import pytorch_lightning as pl
from annotated_types import Ge, MinLen
from omegaconf import DictConfig
from pydantic import Field, with_config
from pytorch_lightning.callbacks import LearningRateMonitor, ModelCheckpoint, ProgressBar
from typing_extensions import TypedDict

from sphericalvision.core import ArgumentError, check_file
from sphericalvision.models import load_weights, save_weights
from sphericalvision.recipes.app.cli import build, print_config
from sphericalvision.recipes.app.kinds import STRICT, Count, Fraction, Number, OnlyWith, Positive, Text
from sphericalvision.recipes.app.words import evaluate_command, resume_command
from sphericalvision.recipes.datamodules.data_module import SampleDataModule
from sphericalvision.recipes.evaluation.tables import save_errors
from sphericalvision.recipes.training.loaders import Loaders
from sphericalvision.recipes.training.module import TrainingModule
from sphericalvision.recipes.training.run_folder import (
    WeightsBesideCheckpoint,
    best_checkpoint,
    changed_settings,
    check_resume,
    resume_path,
    run_folder,
)
from sphericalvision.recipes.training.stages import train_stages

TrainerKeys = TypedDict(  # noqa: UP013 (Lightning has these names, this file has not: as a class they are dead code)
    "TrainerKeys",
    {
        "max_steps": Annotated[int, Ge(-1)],
        "max_time": Annotated[
            str, Field(pattern=r"^\d+:\d\d:\d\d:\d\d$", description="days to seconds as 00:12:00:00")
        ]
        | dict[str, Any]
        | None,
        "val_check_interval": Count,
        "check_val_every_n_epoch": None,
        "limit_val_batches": Count | Fraction | None,
        "num_sanity_val_steps": Annotated[int, Ge(-1)],
        "accelerator": Literal["auto", "cpu", "gpu", "cuda", "mps", "tpu"],
        "devices": Literal["auto", -1]
        | Count
        | Annotated[str, Field(pattern=r"^\d+(,\d+)*$", description="numbers of GPUs as 0,2")]
        | Annotated[list[Number], MinLen(1)],
        "num_nodes": Count,
        "use_distributed_sampler": Literal[False],
        "accumulate_grad_batches": Count,
        "gradient_clip_val": Annotated[float, Ge(0)] | None,
        "overfit_batches": Number | Fraction,
        "log_every_n_steps": Number,
        "profiler": Literal["simple", "advanced", "pytorch"] | dict[str, Any] | None,
    },
    total=False,
)
"""Keys of the group ``trainer`` that Lightning's own hints leave more open; the others are compared with those."""
with_config(STRICT)(TrainerKeys)


@with_config(STRICT)
class TrainKeys(TypedDict, total=False):
    """Keys of ``conf/train.yaml``; those that are ``Any`` are groups, compared with what their parts take."""

    output: Text
    tags: list[str | int]
    seed: Number
    resume: Text | None
    init_weights: Text | None
    result: Text | None
    stages: dict[str, Positive] | None
    task: Any
    model: Any
    rig: Annotated[Any, OnlyWith("data.rig", "data=scenes")]
    data: Annotated[Any, OnlyWith("data.mesh", subkeys=("mesh_up", "mesh_scale"))]
    loss: Any
    optimizer: Any
    scheduler: Any
    trainer: TrainerKeys
    callbacks: Any
    logger: Any
    paths: Any


class Run(NamedTuple):
    """The objects of a training run."""

    module: TrainingModule
    data: SampleDataModule
    loaders: Loaders
    trainer: pl.Trainer


def instantiate_run(config: DictConfig, folder: Path) -> Run:
    """Make network, data and trainer of a config; results go to ``folder``."""
    pl.seed_everything(config.seed, workers=True, verbose=False)
    config.paths.run = str(folder)
    net = build(config.model, "model")
    components = {name: build(config[name], name) for name in ("loss", "optimizer", "scheduler")}
    module: TrainingModule = build(config.task, "task", net=net, **components)
    check_optimization(module)
    data: SampleDataModule = build(config.data, "data")
    data.bind_network(net)
    loggers = build_all(config, "logger")
    callbacks = build_all(config, "callbacks")
    if not loggers:  # Lightning refuses a callback that has nowhere to write
        callbacks = [callback for callback in callbacks if not isinstance(callback, LearningRateMonitor)]
    bars = any(isinstance(callback, ProgressBar) for callback in callbacks)
    trainer = build(
        config.trainer,
        "trainer",
        default_root_dir=str(folder),
        callbacks=callbacks,
        logger=loggers or False,
        plugins=[WeightsBesideCheckpoint(net)],
        enable_progress_bar=bars,
        enable_checkpointing=any(isinstance(callback, ModelCheckpoint) for callback in callbacks),
    )
    return Run(module, data, Loaders(data), trainer)


def build_all(config: DictConfig, group: str) -> list[Any]:
    """The objects of a group whose files name several; those that are null are left out."""
    nodes = config.get(group) or {}
    return [build(node, f"{group}.{name}") for name, node in nodes.items() if node is not None]


def check_optimization(module: TrainingModule) -> None:
    """Make optimiser and schedule once, so that wrong values are told before anything starts."""
    try:
        module.configure_optimizers()
    except (ValueError, TypeError, ZeroDivisionError) as error:
        raise ArgumentError(f"optimizer, scheduler: torch refuses these values: {error}") from error


def begin_logging(config: DictConfig, trainer: pl.Trainer) -> None:
    """Let every logger begin, so that a key or a server that it lacks is told before anything is rendered."""
    names = [name for name, node in (config.logger or {}).items() if node is not None]
    for name, logger in zip(names, trainer.loggers, strict=True):
        try:
            _ = getattr(logger, "experiment", None)
        except Exception as error:  # whatever the packages behind loggers raise
            reason = " ".join(str(error).split()) or type(error).__name__
            offline = f", set logger.{name}.offline=true" if "offline" in config.logger[name] else ""
            raise ArgumentError(
                f"logger.{name}: cannot begin ({reason:.200}); give it what it lacks{offline}, or take logger=default"
            ) from error


def train_objective(config: Annotated[DictConfig, TrainKeys], folder: Path) -> float:
    """Train, and return the value that a sweep compares; of stages the last one's error."""
    if config.stages is not None:
        return train_stages(config, folder)
    return train(config, folder)[config.task.monitor.rpartition("/")[2].replace("over_", ">")]


def train(config: DictConfig, folder: Path) -> dict[str, float]:
    """Train as ``config`` says and return the validation metrics of the best checkpoint.

    Raises:
        ArgumentError: ``folder`` holds a training that ``resume`` does not go on with, or one is at work in it.
    """
    start = config.init_weights
    if start is None and config.task.get("mean_with"):
        raise ArgumentError(
            "task.mean_with: expected init_weights as well, of which the mean is taken; set init_weights=..."
        )
    if config.result is not None and start is not None and Path(start).parent == Path(config.paths.stages):
        check_file(
            start, "weights of the stage before; train that first, or all by experiment=refinedsweepnet"
        )
    with run_folder(folder):
        return train_in(folder, resume_path(config.resume, folder), config)


def train_in(folder: Path, checkpoint: Path | None, config: DictConfig) -> dict[str, float]:
    """Train in a folder that no one else uses, from a checkpoint if there is one."""
    for pattern in (
        ".*exists and is not empty.*",
        ".*not resumable.*",
        ".*many workers.*",
        ".*LeafSpec.*",
        ".*logging interval.*",
        ".*lr_scheduler.step.*",
    ):
        warnings.filterwarnings("ignore", pattern)
    logging.getLogger("pytorch_lightning").setLevel(logging.WARNING)
    module, data, loaders, trainer = instantiate_run(config, folder)
    if trainer.is_global_zero:
        changes = [] if checkpoint is None else changed_settings(checkpoint.parent.parent, config)
        check_resume(checkpoint, module)
        begin_logging(config, trainer)
        print_config(config, folder)
        if config.resume == "auto":
            print(
                f"resume=auto: continues from {checkpoint}"
                if checkpoint
                else f"resume=auto: {folder} has no checkpoint, training starts from the beginning"
            )
        if changes:
            print(f"Goes on from {checkpoint} with other settings: {'; '.join(changes)}")
    # A capture is taught by the weights at the start, also to a run that goes on; Lightning loads those of the
    # checkpoint later.
    if config.init_weights is not None and (checkpoint is None or not data.has_truth):
        module.initialize(config.init_weights)
    last = folder / "checkpoints" / "last.ckpt"
    try:
        trainer.fit(module, loaders, ckpt_path=checkpoint, weights_only=True)
    except SystemExit as stopped:  # what Lightning makes of Ctrl+C and of a job queue's signal
        for sentence in data.left_out():
            print(f"Warning: {sentence}")
        if trainer.is_global_zero and last.is_file():
            print(f"\nStopped at step {trainer.global_step}. Go on with:\n{resume_command(last)}", flush=True)
        sigterm = getattr(trainer, "received_sigterm", False)
        status = 143 if sigterm else 130 if stopped.code in (0, 1, None) else stopped.code  # as in shells
        raise SystemExit(status) from None
    trainer.save_checkpoint(last)
    best = best_checkpoint(trainer, module, loaders, last)
    trainer.validate(module, loaders, ckpt_path=best, weights_only=True, verbose=False)
    values = logged_values(trainer, module, "val")
    report(f"validation ({module.unit})", folder / "validation", trainer, values)
    if type(module).test_step is not pl.LightningModule.test_step:
        trainer.test(module, loaders, ckpt_path=best, weights_only=True, verbose=False)
        report(f"test ({module.unit})", folder / "test", trainer, logged_values(trainer, module, "test"))
    for sentence in data.left_out():
        print(f"Warning: {sentence}")
    if trainer.is_global_zero:
        module.write_report(data, values, config.init_weights, folder)
        if config.result is not None:
            save_weights(load_weights(best.with_suffix(".safetensors")), config.result, bits=8)
            print(f"\nWeights of this stage: {config.result}")
        print(f"\nResults are in {folder}")
        print(f"Resume:   {resume_command(last, 2 * trainer.global_step)}")
        if data.has_truth and best.with_suffix(".safetensors").is_file():
            print(f"Evaluate: {evaluate_command(best, config, data.of_training)}")
    return values


def logged_values(trainer: pl.Trainer, module: TrainingModule, split: str) -> dict[str, float]:
    """The metrics of the last validation ("val") or test ("test"), by name."""
    keys = {name: f"{split}/{name.replace('>', 'over_')}" for name in module.metric_names}
    return {name: float(trainer.callback_metrics[key]) for name, key in keys.items()}


def report(title: str, stem: Path, trainer: pl.Trainer, values: dict[str, float]) -> None:
    """Print the best checkpoint's metrics and save them in the run's folder."""
    if trainer.is_global_zero:
        save_errors(stem, title, {f"step {trainer.global_step}, best checkpoint": values})
