# SPDX-License-Identifier: Apache-2.0
"""A training in stages: each is an experiment whose weights the next one starts from."""

import math
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from sphericalvision.core import ArgumentError
from sphericalvision.io.files import write_bytes
from sphericalvision.recipes import train
from sphericalvision.recipes.app.cli import build, print_table, say
from sphericalvision.recipes.app.errors import several_processes
from sphericalvision.recipes.app.words import own_configs
from sphericalvision.recipes.evaluation.records import read_json, write_json
from sphericalvision.recipes.training.run_folder import changed_settings, flat_settings

OF_STAGES = ("experiment=", "stages=", "output=", "resume=", "result=", "paths.stages=")
"""Words of the whole command line that its stages set themselves."""
HOURS = "hours.json"
"""File next to the weights: stage -> hours that it has taken."""


class Stage(NamedTuple):
    """One experiment.

    Attributes:
        name: of the experiment.
        hours: of one core that it takes.
        words: of ``sphericalvision-train``.
        config: what these words come to.
    """

    name: str
    hours: float
    words: list[str]
    config: DictConfig

    @property
    def result(self) -> Path:
        """The file of weights, which is there once the stage is done."""
        return Path(self.config.result)

    @property
    def gigabytes(self) -> float:
        """Size of the samples that it renders and keeps, at most."""
        data = build(self.config.data, "data")
        data.bind_network(build(self.config.model, "model"))
        return float(getattr(data, "cache_bytes", 0) / 1e9)


def train_stages(config: DictConfig, folder: Path) -> float:
    """Train the stages of a configuration in their order, but for those that are done.

    Each may be stopped at any time; the same command goes on with it.

    Args:
        config: with ``stages``.
        folder: for the weights of all, and a folder for each.

    Returns:
        The validated error of the last stage.

    Raises:
        ArgumentError: a stage has no ``result``.
        SystemExit: one was stopped, or failed.
    """
    stages = [stage_of(name, hours, folder) for name, hours in config.stages.items()]
    print_plan(stages)
    for stage in stages:
        if not stage.result.is_file():
            began = time.monotonic()
            say(f"\n{stage.name}", style="bold")
            run_training(stage.words, stage.config)
            note(stage, time.monotonic() - began, folder)
    say(
        f"\nAll stages are done. Weights: {stages[-1].result}\nHow they were made: {write_card(stages, folder)}"
    )
    return float(next(iter(errors_of(stages[-1]).values()), {}).get("MAE", math.nan))


def stage_of(name: str, hours: float, folder: Path) -> Stage:
    """A stage with the words of this command line."""
    words = [word for word in HydraConfig.get().overrides.task if not word.startswith(OF_STAGES)]
    overrides = [f"experiment={name}", *words, f"paths.stages={folder}", "resume=auto"]
    config = compose("train", overrides)
    if config.result is None:
        raise ArgumentError(
            f"stages.{name}: this experiment sets no result=, the file of weights that says that it is done"
        )
    return Stage(name, hours, [*own_configs(), *overrides], config)


def print_plan(stages: list[Stage]) -> None:
    """Print which stages are done, and how much time and disk the others will take."""
    rows = []
    for stage in stages:
        state = "done" if stage.result.is_file() else f"{stage.hours:g}"
        steps = str(stage.config.trainer.max_steps)
        rows.append([stage.name, steps, state, f"{stage.gigabytes:.1f}"])
    print_table("stages", ["experiment", "iterations", "core-hours", "GB of samples at most"], rows)
    for stage in stages:
        changes = changed_settings(Path(stage.config.output), stage.config)
        if stage.result.is_file() and changes:
            say(
                f"{stage.name} was done with other settings ({'; '.join(changes[:3])}); remove {stage.result} and "
                f"{stage.config.output} to have it done again"
            )


def run_training(words: list[str], config: DictConfig) -> None:
    """Do what ``sphericalvision-train`` does with words that come to a configuration.

    Raises:
        SystemExit: it stopped before its end.
    """
    if not several_processes(config):
        train.main(words)
        return
    # Lightning starts further processes by repeating the command line, which has to be that of this training.
    process = subprocess.Popen([sys.executable, "-m", train.__name__, *words])
    try:
        status = process.wait()
    except KeyboardInterrupt:  # has reached that process, too: it saves where it is
        status = process.wait()
    if status:
        raise SystemExit(status)


def note(stage: Stage, seconds: float, folder: Path) -> None:
    """Add to the hours that a stage has taken."""
    write_json(folder / HOURS, {**read_if_there(folder / HOURS), stage.name: seconds / 3600})


def errors_of(stage: Stage) -> dict[str, dict[str, float]]:
    """Errors that were validated at its end."""
    return read_if_there(Path(stage.config.output) / "validation.json")


def read_if_there(path: Path) -> dict[str, Any]:
    """Read a file of ``write_json``; nothing where there is none."""
    return read_json(path) if path.is_file() else {}


def write_card(stages: list[Stage], folder: Path) -> Path:
    """Write which command made the weights, of what, in how much time, and how well they do."""
    measured = read_if_there(folder / HOURS)
    lines = [
        f"# {stages[-1].result.stem}",
        "",
        "```",
        " ".join(["sphericalvision-train", *HydraConfig.get().overrides.task]),
        "```",
        "",
        "| stage | iterations | hours | seed | validated, percent of N |",
        "|---|---:|---:|---:|---|",
    ]
    for stage in stages:
        time_taken = f"{measured[stage.name]:.2f}" if stage.name in measured else "before"
        errors = next(iter(errors_of(stage).values()), {})
        text = ", ".join(f"{name} {value:.2f}" for name, value in errors.items())
        config = stage.config
        lines.append(f"| {stage.name} | {config.trainer.max_steps} | {time_taken} | {config.seed} | {text} |")
    lines += ["", "## Settings", ""]
    for stage in stages:
        settings = flat_settings(stage.config)
        values = [f"`{key}={value}`" for key, value in settings.items() if value is not None]
        lines += [f"* {stage.name}: {', '.join(values)}"]
    path = stages[-1].result.with_suffix(".md")
    write_bytes(path, "\n".join([*lines, ""]).encode())
    return path
