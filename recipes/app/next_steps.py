# SPDX-License-Identifier: Apache-2.0
"""Command lines that a finished or stopped training prints, with real paths."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from sphericalvision.recipes.app.words import unquote_paths

__all__ = ["evaluate_command", "own_configs", "resume_command"]


def resume_command(last: Path, max_steps: int | None = None) -> str:
    """Command line that goes on with this run in the same folder, to ``max_steps`` if given."""
    replaced = ("resume=", "output=", *(["trainer.max_steps="] if max_steps else []))
    given = [word for word in HydraConfig.get().overrides.task if not word.startswith(replaced)]
    longer = [f"trainer.max_steps={max_steps}"] if max_steps else []
    alone = (
        ["hydra.mode=RUN"] if HydraConfig.get().mode == RunMode.MULTIRUN else []
    )  # a file of hparams sweeps
    words = [
        *own_configs(),
        *unquote_paths(given),
        *alone,
        *longer,
        f"output={last.parent.parent}",
        f"resume={last}",
    ]
    return shlex.join(["sphericalvision-train", *words])


def own_configs() -> list[str]:
    """The flag ``--config-dir`` of this run, if it has one."""
    sources = HydraConfig.get().runtime.config_sources
    return [word for s in sources if s.provider == "command-line" for word in ("--config-dir", s.path)]


def evaluate_command(best: Path, config: DictConfig, of_training: Sequence[str]) -> str:
    """Command line that evaluates the best checkpoint on the test split of the same data, without keys of training."""
    choices = HydraConfig.get().runtime.choices
    groups = [f"data={choices['data']}"] + ([f"rig={choices['rig']}"] if "rig" in config.data else [])
    usual = compose("evaluate", groups)
    known = {group: set(usual[group]) for group in ("rig", "data")}  # "in" says no to keys that lack a value
    changes = [
        f"{group}.{key}={value}".replace(" ", "").replace("None", "null")
        for group, keys in known.items()
        for key, value in config[group].items()
        if key in keys and key != "rig" and (group == "rig" or key not in of_training)
        if group == "data" or "rig" in config.data
        if OmegaConf.is_missing(usual[group], key) or usual[group][key] != value
    ]
    words = [*own_configs(), f"checkpoint={best.with_suffix('.safetensors')}", *groups, *changes]
    return shlex.join(["sphericalvision-evaluate", *words])
