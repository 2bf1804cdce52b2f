# SPDX-License-Identifier: Apache-2.0
"""The trainings of a study: multi-runs of ``sphericalvision-train``."""

import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from sphericalvision.core import ArgumentError
from sphericalvision.recipes.app.cli import console
from sphericalvision.recipes.app.errors import several_processes
from sphericalvision.recipes.app.words import own_configs, quote_paths
from sphericalvision.recipes.training.run_folder import changed_settings, flat_settings
from sphericalvision.recipes.training.stages import run_training


def training_config(words: Sequence[str]) -> DictConfig:
    """Compose the configuration of ``sphericalvision-train`` with these words; wrong ones are refused."""
    return compose("train", quote_paths(list(words)))


class Training(NamedTuple):
    """One model and seed.

    Attributes:
        model: its name.
        seed: of parameters, order and augmentation.
        folder: where ``sphericalvision-train`` writes.
        words: its words, without ``output`` and ``resume``; the last is the seed.
        config: composed from these words.
    """

    model: str
    seed: int
    folder: Path
    words: tuple[str, ...]
    config: DictConfig

    @property
    def name(self) -> str:
        """Name of the training in messages."""
        return f"{self.model}, seed {self.seed}"

    @property
    def settings(self) -> dict[str, Any]:
        """The keys that its result depends on, with dots."""
        return flat_settings(self.config)

    @property
    def weights(self) -> Path:
        """The network with the least error in validation."""
        return self.folder / "checkpoints" / "best.safetensors"

    @property
    def changes(self) -> list[str]:
        """Settings in which an earlier training in this folder differs, with both values."""
        return changed_settings(self.folder, self.config)

    @property
    def is_done(self) -> bool:
        """True if it reached its end with these settings: its last table exists."""
        ends = (self.folder / "validation.json", self.weights)
        return all(path.is_file() for path in ends) and not self.changes


def train_all(trainings: Sequence[Training], train_missing: bool, on_change: str) -> None:
    """Bring all trainings to their end.

    Args:
        trainings: of all models and seeds.
        train_missing: False leaves out what is not trained yet.
        on_change: of trainings with other settings: "refuse" them, or "redo" them. All are compared before any begins.

    Raises:
        ArgumentError: one has other settings, and ``on_change`` is "refuse".
        SystemExit: one stopped before its end; the same study resumes it.
    """
    for training in trainings:
        if changes := "; ".join(training.changes[:3]):
            if on_change == "refuse":
                raise ArgumentError(
                    f"{training.name}: trained in {training.folder} with other settings ({changes}). Restore them, "
                    "choose another output=..., or train it again with on_change=redo"
                )
            console.print(f"{training.name}: {changes}; it will be retrained", highlight=False)
            shutil.rmtree(training.folder)
    pending: dict[str, list[Training]] = {}
    for training in trainings:
        if training.is_done:
            console.print(f"{training.name}: already trained", highlight=False)
        elif train_missing:
            pending.setdefault(training.model, []).append(training)
        else:
            console.print(f"{training.name}: not trained, left out (train=false)", highlight=False)
    for seeds in pending.values():
        for words in command_lines(seeds):
            try:
                run_training(words, seeds[0].config)
            except (Exception, SystemExit):
                command = shlex.join(["sphericalvision-train", *words])
                print(
                    "\nA training stopped. Finished work is kept: repeat the study to resume, or run it alone:\n"
                    + command,
                    file=sys.stderr,
                )
                raise


def command_lines(seeds: Sequence[Training]) -> list[list[str]]:
    """The words of ``sphericalvision-train`` for the seeds of a model: one multi-run, in the launcher of the study.

    A training in several processes is a command of its own, as Lightning starts them by repeating it.
    """
    first, hydra = seeds[0], HydraConfig.get()
    if several_processes(first.config):
        return [[*own_configs(), *seed.words, f"output={seed.folder}", "resume=auto"] for seed in seeds]
    launcher = [f"launcher={name}"] if (name := hydra.runtime.choices["launcher"]) else []
    launcher += [
        word for word in hydra.overrides.hydra if word.startswith(("hydra.launcher", "hydra/launcher"))
    ]
    values = ",".join(str(training.seed) for training in seeds)
    folders = [f"output={first.folder.parent}", "hydra.sweep.subdir=seed${seed}", "resume=auto"]
    return [[*own_configs(), "--multirun", *launcher, *first.words[:-1], f"seed={values}", *folders]]


def differences(trainings: Sequence[Training]) -> list[str]:
    """Sentences about settings of data and trainer that differ between models, which then compare unfairly."""
    settings = [training.settings for training in trainings]
    keys = {key: None for each in settings for key in each if key.startswith(("data.", "trainer."))}
    values = {key: sorted({str(each.get(key)) for each in settings}) for key in keys}
    return [f"{key} differs between models: {', '.join(v)}" for key, v in values.items() if len(v) > 1]
