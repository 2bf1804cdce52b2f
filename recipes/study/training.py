# SPDX-License-Identifier: Apache-2.0
"""The trainings of a study: runs of ``sphericalvision-train`` that Hydra's launcher starts."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import traceback
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import torch
from hydra import compose
from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobStatus
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

from sphericalvision.core import ArgumentError, SphericalVisionError, check_choice
from sphericalvision.recipes.app.cli import console
from sphericalvision.recipes.app.help import walk
from sphericalvision.recipes.app.words import own_configs, quote_paths

__all__ = [
    "Training",
    "TrainingError",
    "check_alike",
    "flat_config",
    "train_all",
    "training_config",
    "training_words",
]

CHANGES_NOTHING = (
    "output",
    "resume",
    "tags",
    "data.cache_dir",
    "data.num_workers",
    "trainer.accelerator",
    "trainer.log_every_n_steps",
    "trainer.enable_model_summary",
)
"""Keys of a training that leave its result as it is."""

ALIKE = (
    "trainer.max_steps",
    "trainer.accumulate_grad_batches",
    "data.root",
    "data.batch_size",
    "data.kind",
    "data.num_train",
    "data.train_seed",
    "data.augment",
)
"""Keys in which models must agree for a fair comparison."""


class TrainingError(SphericalVisionError, RuntimeError):
    """A training did not reach its end."""


class Training(NamedTuple):
    """One model and seed.

    Attributes:
        name: what it is called in messages.
        folder: where ``sphericalvision-train`` writes.
        words: its words, without ``output`` and ``resume``.
        config: what these words come to, flat, without what changes nothing.
    """

    name: str
    folder: Path
    words: tuple[str, ...]
    config: dict[str, Any]

    @classmethod
    def of(
        cls, model: str, own: Sequence[str] | None, seed: int, config: DictConfig, folder: Path
    ) -> Training:
        """The training of a model: words of ``training``, its own, then ``extra_training``."""
        words = (*training_words(own, config), f"seed={seed}")
        home = folder / "models" / model / f"seed{seed}"
        return cls(f"{model}, seed {seed}", home, words, flat_config(training_config(words)))

    @property
    def weights(self) -> Path:
        """The network with the least error in validation."""
        return self.folder / "checkpoints" / "best.safetensors"

    @property
    def changes(self) -> list[str]:
        """Keys in which an earlier training in this folder differs, with both values."""
        settings = self.folder / "config.yaml"
        if not settings.is_file():
            return []
        old = flat_config(OmegaConf.load(settings))  # type: ignore[arg-type]
        keys = [key for key in {**old, **self.config} if old.get(key) != self.config.get(key)]
        return [f"{key} was {old.get(key)}, is {self.config.get(key)}" for key in keys]

    @property
    def is_done(self) -> bool:
        """Whether it reached its end, with these words: its last table is there."""
        ends = (self.folder / "validation.json", self.weights)
        return all(path.is_file() for path in ends) and not self.changes

    @property
    def all_words(self) -> list[str]:
        """The words of this training; the same ones start it and go on with it."""
        return [*self.words, f"output={self.folder}", "resume=auto"]

    def check(self, on_change: str) -> None:
        """Refuse what was trained with other words, or throw it away, as ``on_change`` says.

        Raises:
            ArgumentError: ``on_change`` is "refuse"; the message names the keys.
        """
        check_choice("on_change", on_change, ("refuse", "redo"))
        changes = self.changes
        if not changes:
            return
        if on_change == "refuse":
            raise ArgumentError(
                f"{self.name}: trained in {self.folder} with other settings ({'; '.join(changes[:3])}). Put them "
                "back, choose another output=..., or have it trained anew with on_change=redo"
            )
        console.print(f"{self.name}: {'; '.join(changes[:3])}; is trained anew", highlight=False)
        shutil.rmtree(self.folder)


def train_all(config: DictConfig, trainings: list[Training]) -> None:
    """Bring all trainings to their end; what was trained otherwise is told before anything begins.

    Raises:
        ArgumentError: one was trained otherwise, and ``config.on_change`` is "refuse".
        TrainingError: one stopped before its end; the same study goes on with it.
    """
    for training in trainings:
        training.check(config.on_change)
    pending = []
    for training in trainings:
        if training.is_done:
            console.print(f"{training.name}: trained already", highlight=False)
        elif config.train:
            pending.append(training)
        else:
            console.print(f"{training.name}: not trained, left out (train=false)", highlight=False)
    if pending:
        launch(pending)


def launch(trainings: list[Training]) -> None:
    """Let the launcher of this run do trainings: one after the other, unless ``launcher=joblib`` or ``submitit``.

    Raises:
        TrainingError: one stopped before its end.
    """
    hydra, mine = GlobalHydra.instance().hydra, HydraConfig.get()
    assert hydra is not None
    elsewhere = [word for word in mine.overrides.hydra if word.startswith("hydra.searchpath=")]
    config = hydra.compose_config(
        "train", [*elsewhere, "hydra.sweep.subdir=."], RunMode.MULTIRUN, with_log_configuration=False
    )
    with open_dict(config):
        config.hydra.launcher = mine.launcher
    context = HydraContext(config_loader=hydra.config_loader, callbacks=Callbacks())
    launcher = Plugins.instance().instantiate_launcher(
        hydra_context=context, task_function=train_here, config=config
    )
    returns = launcher.launch([quote_paths(training.all_words) for training in trainings], 0)
    for training, result in zip(trainings, returns, strict=True):
        if result.status is not JobStatus.COMPLETED:
            error = result._return_value
            if not isinstance(error, (SphericalVisionError, OSError)):
                traceback.print_exception(error)
            raise TrainingError(
                f"{training.name}: the training stopped ({error}). What is done is kept: start the study again to go "
                "on, or see what happens with\n"
                f"{shlex.join(['sphericalvision-train', *own_configs(), *training.all_words])}"
            ) from error


def train_here(config: DictConfig) -> None:
    """The task of a training, in whatever process the launcher has chosen."""
    from sphericalvision.recipes.commands.train import train

    words = [*own_configs(), *HydraConfig.get().overrides.task]
    # Lightning starts further processes of a training by the command line of this one, and tells them by variables.
    with (
        mock.patch.object(sys.modules["__main__"], "__spec__", find_spec("sphericalvision.recipes.train")),
        mock.patch.object(sys, "argv", ["sphericalvision-train", *words]),
        mock.patch.dict(os.environ),
    ):
        train(config, Path(HydraConfig.get().runtime.output_dir))
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def training_words(own: Sequence[str] | None, config: DictConfig) -> tuple[str, ...]:
    """Words of ``training``, a model's own, and of ``extra_training``; later ones win."""
    return (*map(str, config.training), *(own or ()), *map(str, config.extra_training))


def training_config(words: tuple[str, ...]) -> DictConfig:
    """The config of ``sphericalvision-train`` with these words; wrong words are told before anything is done."""
    return compose("train", quote_paths(list(words)))


ROOMS = ("paths.", "callbacks.", "logger.")
"""Beginnings of keys that leave the result of a training as it is."""

NAMES = "_target_"
"""Last parts of keys that say where in the package something is: it may move, and a training stays what it was."""


def flat_config(config: DictConfig) -> dict[str, Any]:
    """All keys with dots, resolved, without those that change nothing.

    Examples:
        >>> flat_config(OmegaConf.create({"output": "here", "data": {"kind": "room"}, "seed": 0}))
        {'data.kind': 'room', 'seed': 0}
    """
    return {
        name: value
        for name, value in walk(OmegaConf.to_container(config, resolve=True, throw_on_missing=False))
        if not (isinstance(value, dict) and value)
        and name not in CHANGES_NOTHING
        and not name.startswith(ROOMS)
        and not name.endswith(NAMES)
    }


def check_alike(trainings: list[Training]) -> list[str]:
    """Sentences about what is not the same for all models: training data, their number, or steps."""
    notes = []
    for key in ALIKE:
        values = {str(training.config.get(key)) for training in trainings}
        if len(values) > 1:
            notes.append(f"{key} differs between models: {', '.join(sorted(values))}")
    return notes
