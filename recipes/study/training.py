# SPDX-License-Identifier: Apache-2.0
"""The trainings of a study: multi-runs of ``sphericalvision-train``."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from sphericalvision.core import ArgumentError
from sphericalvision.recipes import train
from sphericalvision.recipes.app.cli import console
from sphericalvision.recipes.app.errors import several_processes
from sphericalvision.recipes.app.words import own_configs, quote_paths
from sphericalvision.recipes.training.run_folder import changed_settings, flat_settings

__all__ = [
    "CHANGES_NOTHING",
    "Training",
    "check_alike",
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
    "paths.*",
    "callbacks.*",
    "logger.*",
    "*_target_",
)
"""Keys of a training that leave its result as it is, and where in the package something is: it may move."""

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


class Training(NamedTuple):
    """One model and seed.

    Attributes:
        model: its name.
        seed: of parameters, order and augmentation.
        folder: where ``sphericalvision-train`` writes.
        words: its words, without ``output`` and ``resume``; the last is the seed.
        composed: what these words come to.
    """

    model: str
    seed: int
    folder: Path
    words: tuple[str, ...]
    composed: DictConfig

    @classmethod
    def of(
        cls, model: str, own: Sequence[str] | None, seed: int, config: DictConfig, folder: Path
    ) -> Training:
        """The training of a model: words of ``training``, its own, then ``extra_training``."""
        words = (*training_words(own, config), f"seed={seed}")
        return cls(model, seed, folder / "models" / model / f"seed{seed}", words, training_config(words))

    @property
    def name(self) -> str:
        """What it is called in messages."""
        return f"{self.model}, seed {self.seed}"

    @property
    def config(self) -> dict[str, Any]:
        """All its keys with dots, without those that change nothing."""
        return flat_settings(self.composed, CHANGES_NOTHING)

    @property
    def weights(self) -> Path:
        """The network with the least error in validation."""
        return self.folder / "checkpoints" / "best.safetensors"

    @property
    def changes(self) -> list[str]:
        """Keys in which an earlier training in this folder differs, with both values."""
        return changed_settings(self.folder, self.composed, CHANGES_NOTHING)

    @property
    def is_done(self) -> bool:
        """Whether it reached its end, with these words: its last table is there."""
        ends = (self.folder / "validation.json", self.weights)
        return all(path.is_file() for path in ends) and not self.changes

    def check(self, on_change: str) -> None:
        """Refuse what was trained with other words, or throw it away, as ``on_change`` says.

        Raises:
            ArgumentError: ``on_change`` is "refuse"; the message names the keys.
        """
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
        SystemExit: one stopped before its end; the same study goes on with it.
    """
    for training in trainings:
        training.check(config.on_change)
    pending: dict[str, list[Training]] = {}
    for training in trainings:
        if training.is_done:
            console.print(f"{training.name}: trained already", highlight=False)
        elif config.train:
            pending.setdefault(training.model, []).append(training)
        else:
            console.print(f"{training.name}: not trained, left out (train=false)", highlight=False)
    lines = [line for seeds in pending.values() for line in command_lines(seeds)]
    for line in lines:
        try:
            run_line(line)
        except (Exception, SystemExit):
            command = shlex.join(["sphericalvision-train", *line])
            print(
                "\nA training stopped. What is done is kept: start the study again to go on, or see what happens with"
                f"\n{command}",
                file=sys.stderr,
            )
            raise


def command_lines(seeds: list[Training]) -> list[list[str]]:
    """The words of ``sphericalvision-train`` for the seeds of a model: one multi-run, in the launcher of the study.

    A training in several processes is a command of its own, as Lightning starts them by repeating it.
    """
    first, mine = seeds[0], HydraConfig.get()
    if several_processes(first.composed):
        return [
            [*own_configs(), *training.words, f"output={training.folder}", "resume=auto"]
            for training in seeds
        ]
    launcher = [f"launcher={name}"] if (name := mine.runtime.choices["launcher"]) else []
    launcher += [
        word for word in mine.overrides.hydra if word.startswith(("hydra.launcher", "hydra/launcher"))
    ]
    together = ",".join(str(training.seed) for training in seeds)
    place = [f"output={first.folder.parent}", "hydra.sweep.subdir=seed${seed}", "resume=auto"]
    return [[*own_configs(), "--multirun", *launcher, *first.words[:-1], f"seed={together}", *place]]


def run_line(words: list[str]) -> None:
    """Do what ``sphericalvision-train`` does with these words, in this process if it is a multi-run."""
    if "--multirun" in words:
        train.main(words)
    elif status := subprocess.run([sys.executable, "-m", train.__name__, *words], check=False).returncode:
        raise SystemExit(status)


def training_words(own: Sequence[str] | None, config: DictConfig) -> tuple[str, ...]:
    """Words of ``training``, a model's own, and of ``extra_training``; later ones win."""
    return (*map(str, config.training), *(own or ()), *map(str, config.extra_training))


def training_config(words: tuple[str, ...]) -> DictConfig:
    """The config of ``sphericalvision-train`` with these words; wrong words are told before anything is done."""
    return compose("train", quote_paths(list(words)))


def check_alike(trainings: list[Training]) -> list[str]:
    """Sentences about what is not the same for all models: training data, their number, or steps."""
    notes, configs = [], [training.config for training in trainings]
    for key in ALIKE:
        values = {str(config.get(key)) for config in configs}
        if len(values) > 1:
            notes.append(f"{key} differs between models: {', '.join(sorted(values))}")
    return notes
