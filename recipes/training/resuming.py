# SPDX-License-Identifier: Apache-2.0
"""Going on with a training: from which checkpoint, whether it fits, and what is set otherwise than before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from sphericalvision.core import ArgumentError, check_file
from sphericalvision.recipes.app.checkpoints import read_checkpoint
from sphericalvision.recipes.app.help import walk
from sphericalvision.recipes.training.module import TrainingModule, name_of
from sphericalvision.recipes.training.run_folder import is_first_process

__all__ = ["changed_settings", "check_resume", "resume_path"]

NO_SETTINGS = ("output", "resume", "init_weights", "paths.run", "tags")
"""Keys that say nothing about what is learned."""

STATE = ("state_dict", "optimizer_states", "lr_schedulers", "loops", "global_step")
"""What a training needs to go on; weights alone are for ``init_weights``."""


def resume_path(resume: str | None, folder: Path) -> Path | None:
    """The checkpoint to resume from: ``auto`` is the folder's last one, if there is any.

    Raises:
        ArgumentError: ``folder`` holds a training that would be overwritten.
        MissingFileError: there is no such checkpoint.
    """
    last = folder / "checkpoints" / "last.ckpt"
    if resume == "auto":
        return last if last.is_file() else None
    wanted = "a Lightning checkpoint to resume from, such as checkpoints/last.ckpt"
    path = None if resume is None else check_file(resume, wanted).absolute()
    there = [name for name in ("last.ckpt", "best.ckpt") if (last.parent / name).is_file()]
    if there and is_first_process() and (path is None or path.parent != last.parent):
        raise ArgumentError(
            f"output: {folder} holds a training already (checkpoints/{there[0]}), which would be overwritten; go on "
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
    mine = {"architecture": name_of(module.net), **module.net.hyperparameters}
    if stored["architecture"] != mine["architecture"]:
        raise ArgumentError(
            f"resume: {path} is a training of {stored['architecture']}, this run trains {mine['architecture']}"
        )
    for key, value in mine.items():
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

    def found(content: dict[str, Any]) -> dict[str, Any]:
        if lacking := [key for key in STATE if key not in content]:
            raise KeyError(f"it lacks {', '.join(lacking)}")
        if not all(value.isfinite().all() for value in content["state_dict"].values()):
            raise ValueError("its weights are infinite or not numbers")
        return {"architecture": content["architecture"], **content["network_hyperparameters"]}

    return read_checkpoint("resume", path, "a checkpoint of sphericalvision-train", found)


def changed_settings(checkpoint: Path, config: DictConfig) -> list[str]:
    """What this run has set otherwise than the run of a checkpoint: ``key was old, is new``."""
    path = checkpoint.parent.parent / "config.yaml"
    if not path.is_file():
        return []
    old = _flat(OmegaConf.to_container(OmegaConf.load(path)))
    new = _flat(OmegaConf.to_container(config, resolve=True, throw_on_missing=False))
    keys = [key for key in {**old, **new} if key not in NO_SETTINGS]
    return [f"{key} was {old.get(key)}, is {new.get(key)}" for key in keys if old.get(key) != new.get(key)]


def _flat(config: Any) -> dict[str, Any]:
    """All keys with dots; paths in the run's own folder are told from there, since the folder may have moved."""
    home = str(config["paths"]["run"])
    leaves = ((key, value) for key, value in walk(config) if not (isinstance(value, dict) and value))
    return {key: value.replace(home, "") if isinstance(value, str) else value for key, value in leaves}
