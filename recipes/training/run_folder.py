# SPDX-License-Identifier: Apache-2.0
"""The folder of a training: one process at a time, its checkpoints, the best of them, and going on from one."""

import copy
import math
import os
import shutil
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.plugins.io import TorchCheckpointIO
from pytorch_lightning.utilities import rank_zero_only
from torch import nn

from sphericalvision.core import ArgumentError, check_file
from sphericalvision.io.files import atomic_write
from sphericalvision.models import DepthNetwork, save_weights
from sphericalvision.models.weights.registry import network_name
from sphericalvision.recipes.app.checkpoints import read_checkpoint
from sphericalvision.recipes.app.cli import changes, read_settings
from sphericalvision.recipes.app.help import walk
from sphericalvision.recipes.training.loaders import Loaders
from sphericalvision.recipes.training.module import TrainingModule, name_of

try:
    import fcntl
except ImportError:  # Windows; two trainings in one folder are not noticed there
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"
"""Held while a training runs; the system lets go of it however the training ends."""


def is_first_process() -> bool:
    """Tell whether this is the process of rank 0, by the variables that those who start several set."""
    return getattr(rank_zero_only, "rank", 0) == 0


@contextmanager
def run_folder(folder: Path) -> Iterator[None]:
    """Keep a folder for one training.

    Raises:
        ArgumentError: another training is at work in it.
    """
    if not is_first_process() or fcntl is None:  # the first process of a training in several holds it for all
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            holder = file.read(200) or "unknown process"
            raise ArgumentError(
                f"output: another training is at work in {folder} ({holder}); wait for its end, or choose another "
                "output=..."
            ) from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
        yield


NO_SETTINGS = (
    *("output", "result", "resume", "stages", "tags", "paths.*", "callbacks.*", "logger.*"),
    *("data.cache_dir", "data.num_workers"),
    *("trainer.accelerator", "trainer.log_every_n_steps", "trainer.enable_model_summary"),
)
"""Keys that a training's result does not depend on: files, the machine, and reports."""

STATE = ("state_dict", "optimizer_states", "lr_schedulers", "loops", "global_step")
"""Keys of a checkpoint that a training needs to go on; weights alone are for ``init_weights``."""


def resume_path(resume: str | None, folder: Path) -> Path | None:
    """The checkpoint to resume from: ``auto`` is the folder's last one or, where there is none, its best.

    Raises:
        ArgumentError: ``folder`` holds a training that would be overwritten.
        MissingFileError: there is no such checkpoint.
    """
    last = folder / "checkpoints" / "last.ckpt"
    names = [name for name in ("last.ckpt", "best.ckpt") if (last.parent / name).is_file()]
    if resume == "auto":
        return last.with_name(names[0]) if names else None
    expected = "a Lightning checkpoint to resume from, such as checkpoints/last.ckpt"
    path = None if resume is None else check_file(resume, expected).absolute()
    if names and is_first_process() and (path is None or path.parent != last.parent):
        raise ArgumentError(
            f"output: {folder} holds a training already (checkpoints/{names[0]}), which would be overwritten; go on "
            "with it by resume=auto, choose another output=..., or remove that folder"
        )
    return path


def check_resume(path: Path | None, module: TrainingModule) -> None:
    """Refuse to resume a network of another shape or scale; its step count would mean nothing here.

    Raises:
        ArgumentError: the first hyper-parameter that differs, with both values.
        FileFormatError: the file is no checkpoint.
    """
    if path is None:
        return
    stored = stored_network(path)
    current = {"architecture": name_of(module.net), **module.net.hyperparameters}
    if stored["architecture"] != current["architecture"]:
        raise ArgumentError(
            f"resume: {path} is a training of {stored['architecture']}, this run trains {current['architecture']}"
        )
    for key, value in current.items():
        if stored.get(key) != value:
            raise ArgumentError(
                f"resume: {path} was trained with {key} = {stored.get(key)}, this run has model.{key} = {value}; "
                f"set model.{key}={stored.get(key)} to go on, or start anew from it with init_weights={path}"
            )


def stored_network(path: Path) -> dict[str, Any]:
    """Name and hyper-parameters of the network in a checkpoint.

    Raises:
        FileFormatError: the file is no checkpoint of this command.
    """

    def network_of(content: dict[str, Any]) -> dict[str, Any]:
        if lacking := [key for key in STATE if key not in content]:
            raise KeyError(f"it lacks {', '.join(lacking)}")
        if not all(value.isfinite().all() for value in content["state_dict"].values()):
            raise ValueError("its weights are infinite or not numbers")
        return {"architecture": content["architecture"], **content["network_hyperparameters"]}

    return read_checkpoint("resume", path, "a checkpoint of sphericalvision-train", network_of)


def changed_settings(folder: Path, config: DictConfig) -> list[str]:
    """Settings in which ``config`` differs from the run in a folder: ``key was old, is new``."""
    written = read_settings(folder / "config.yaml")
    return changes(flat_settings(OmegaConf.create(written)), flat_settings(config)) if written else []


def flat_settings(config: Any) -> dict[str, Any]:
    """All keys that a training's result depends on, with dots, resolved.

    Paths in the run's own folder are relative to it, since the folder may have moved.

    Examples:
        >>> config = OmegaConf.create({"output": "here", "data": {"kind": "room", "num_workers": 4}})
        >>> flat_settings(config)
        {'data.kind': 'room'}
    """
    plain: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    home = str(plain.get("paths", {}).get("run") or "")
    leaves = ((key, value) for key, value in walk(plain) if not (isinstance(value, dict) and value))
    return {
        key: value.replace(home, "") if home and isinstance(value, str) else value
        for key, value in leaves
        if not any(fnmatchcase(key, pattern) for pattern in NO_SETTINGS)
    }


def best_checkpoint(trainer: pl.Trainer, module: TrainingModule, loaders: Loaders, last: Path) -> Path:
    """Return the best checkpoint of a training that has ended; the last state counts, too.

    Where the number of steps is no multiple of ``trainer.val_check_interval``, the last state has not been validated
    yet. It is now, and takes the place of the best one if it is better.

    ``last`` is the checkpoint of the last state.
    """
    keeper = trainer.checkpoint_callback
    if not isinstance(keeper, ModelCheckpoint) or not keeper.best_model_path:
        return last
    best = Path(keeper.best_model_path)
    if keeper.best_model_score is None or module.validated_step == trainer.global_step:
        return best
    trainer.validate(module, loaders, ckpt_path=last, weights_only=True, verbose=False)
    score, former = float(trainer.callback_metrics[module.monitor]), float(keeper.best_model_score)
    better = score < former if module.mode == "min" else score > former
    if trainer.is_global_zero and (better or math.isnan(former)):
        for suffix in (".ckpt", ".safetensors"):
            if last.with_suffix(suffix).is_file():
                with atomic_write(best.with_suffix(suffix)) as temporary:
                    shutil.copyfile(last.with_suffix(suffix), temporary)
    trainer.strategy.barrier()
    return best


class WeightsBesideCheckpoint(TorchCheckpointIO):
    """Lightning's checkpoints, and next to each ``.ckpt`` a depth network's weights alone as ``.safetensors``.

    Either file appears whole or not at all, so an interruption while saving leaves the previous ones.
    """

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net: DepthNetwork | None = None
        if isinstance(net, DepthNetwork):
            try:
                network_name(net)
                self.net = net
            except ArgumentError as error:
                warnings.warn(f"weights alone are not written: {error}", stacklevel=2)

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None
    ) -> None:
        """Write both files."""
        path = Path(path)
        with atomic_write(path) as temporary:
            super().save_checkpoint(checkpoint, temporary, storage_options)
        net = self.net
        if net is None:
            return
        if "current_model_state" in checkpoint:
            # Of averaged weights, which were validated; the network has others.
            net = copy.deepcopy(net)
            state = checkpoint["state_dict"].items()
            net.load_state_dict({name[4:]: value for name, value in state if name.startswith("net.")})
        save_weights(net, path.with_suffix(".safetensors"))

    def remove_checkpoint(self, path: Any) -> None:
        """Remove both files."""
        super().remove_checkpoint(path)
        Path(path).with_suffix(".safetensors").unlink(missing_ok=True)
