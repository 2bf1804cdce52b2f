# SPDX-License-Identifier: Apache-2.0
"""The trainings of a study, each by ``sphericalvision-train`` in a process of its own."""

from __future__ import annotations

import ctypes
import json
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from sphericalvision.core import ArgumentError, FileFormatError, SphericalVisionError, check_choice
from sphericalvision.io.files import atomic_write
from sphericalvision.recipes.app.cli import console
from sphericalvision.recipes.app.next_steps import own_configs
from sphericalvision.recipes.app.words import quote_paths
from sphericalvision.recipes.study.models import StudyModel

__all__ = ["Training", "TrainingError", "check_alike", "read_json", "training_config", "write_json"]

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
    def of(cls, model: StudyModel, seed: int, config: DictConfig, folder: Path) -> Training:
        """The training of a model: words of ``training``, its own, then ``extra_training``."""
        words = (*training_words(model, config), f"seed={seed}")
        home = folder / "models" / model.name / f"seed{seed}"
        return cls(f"{model.name}, seed {seed}", home, words, flat_config(training_config(words)))

    @property
    def record(self) -> Path:
        """The file that tells what was trained here."""
        return self.folder / "training.json"

    @property
    def weights(self) -> Path:
        """The network with the least error in validation."""
        return self.folder / "checkpoints" / "best.safetensors"

    @property
    def changes(self) -> list[str]:
        """Keys in which an earlier training in this folder differs, with both values."""
        if not self.record.is_file():
            return []
        old = read_json(self.record)["config"]
        keys = [key for key in {**old, **self.config} if old.get(key) != self.config.get(key)]
        return [f"{key} was {old.get(key)}, is {self.config.get(key)}" for key in keys]

    @property
    def is_done(self) -> bool:
        """Whether it reached its end, with these words."""
        if not self.record.is_file() or not self.weights.is_file():
            return False
        return bool(read_json(self.record)["finished"]) and not self.changes

    @property
    def command(self) -> list[str]:
        """The command line of this training; the same one starts it and goes on with it."""
        own = own_configs() if HydraConfig.initialized() else []
        words = [*own, *self.words, f"output={self.folder}", "resume=auto"]
        return [sys.executable, "-m", "sphericalvision.recipes.train", *words]

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

    def run(self) -> None:
        """Train, or go on; returns when the training has reached its end.

        Raises:
            TrainingError: it stopped before; the same study goes on with it.
        """
        before = read_json(self.record)["seconds"] if self.record.is_file() else 0.0
        facts = {"config": self.config, "words": self.words, "finished": False, "seconds": before}
        write_json(self.record, facts)
        began = time.monotonic()
        status = _run(self.command)
        facts["seconds"] = before + time.monotonic() - began
        facts["finished"] = status == 0 and self.weights.is_file()
        write_json(self.record, facts)
        if not facts["finished"]:
            raise TrainingError(
                f"{self.name}: the training stopped with status {status}. What is done is kept: start the study again "
                f"to go on, or see what happens with\n{shlex.join(self.command)}"
            )


def training_words(model: StudyModel, config: DictConfig) -> tuple[str, ...]:
    """Words of ``training``, of the model, and of ``extra_training``; later ones win."""
    return (*map(str, config.training), *(model.train or ()), *map(str, config.extra_training))


def training_config(words: tuple[str, ...]) -> DictConfig:
    """The config of ``sphericalvision-train`` with these words; wrong words are told before anything is done."""
    return compose("train", quote_paths(list(words)))


ROOMS = ("paths.", "callbacks.", "logger.")
"""Beginnings of keys that leave the result of a training as it is."""

PR_SET_PDEATHSIG = 1
"""Of ``prctl`` of Linux: which signal the death of the parent is told by."""

NAMES = "_target_"
"""Last parts of keys that say where in the package something is: it may move, and a training stays what it was."""


def flat_config(config: DictConfig) -> dict[str, Any]:
    """All keys with dots, resolved, without those that change nothing.

    Examples:
        >>> flat_config(OmegaConf.create({"output": "here", "data": {"kind": "room"}, "seed": 0}))
        {'data.kind': 'room', 'seed': 0}
    """
    flat: dict[str, Any] = {}

    def walk(node: Any, prefix: str) -> None:
        for key, value in node.items():
            name = f"{prefix}{key}"
            if isinstance(value, dict) and value:
                walk(value, f"{name}.")
            elif name not in CHANGES_NOTHING and not name.startswith(ROOMS) and not name.endswith(NAMES):
                flat[name] = value

    walk(OmegaConf.to_container(config, resolve=True, throw_on_missing=False), "")
    return flat


def check_alike(trainings: list[Training]) -> list[str]:
    """Sentences about what is not the same for all models: training data, their number, or steps."""
    notes = []
    for key in ALIKE:
        values = {str(training.config.get(key)) for training in trainings}
        if len(values) > 1:
            notes.append(f"{key} differs between models: {', '.join(sorted(values))}")
    return notes


def read_json(path: Path) -> dict[str, Any]:
    """What ``write_json`` wrote.

    Raises:
        FileFormatError: the file is damaged.
    """
    try:
        content = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        content = error
    if not isinstance(content, dict):
        raise FileFormatError(
            f"{path}: is damaged ({content!r:.200}); remove it, and what it tells is done again"
        )
    return content


def write_json(path: Path, content: Any) -> None:
    """Write a whole file or none; folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        Path(temporary).write_text(json.dumps(content, indent=2) + "\n")


def _end_with_parent() -> None:
    """Have the system stop this process when the study is no more: ``kill -9`` leaves it no time to say so itself.

    A training that went on alone would hold its folder, and the study that is started again could not go on.
    """
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def _run(command: list[str]) -> int:
    """Run to the end; when this process is told to stop the training is told, and may keep what it has."""

    def stop(*_: Any) -> None:
        raise SystemExit(143)

    previous = signal.signal(signal.SIGTERM, stop)
    try:
        process = subprocess.Popen(command, preexec_fn=_end_with_parent if sys.platform == "linux" else None)
        try:
            return process.wait()
        except KeyboardInterrupt:  # the terminal has told the training, too
            process.wait()
            raise
        except SystemExit:
            process.terminate()
            process.wait()
            raise
    finally:
        signal.signal(signal.SIGTERM, previous)
