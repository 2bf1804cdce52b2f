# SPDX-License-Identifier: Apache-2.0
"""Measure speed: ``sphericalvision-benchmark groups=[network]``.

Every figure stands beside a plain way to do the same work, run in turns with it; ratios are what counts.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import torch
from omegaconf import DictConfig

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.recipes.app.cli import choose_device, console
from sphericalvision.recipes.benchmark.measuring import Comparison, Measurement, measure, peaks_of
from sphericalvision.recipes.benchmark.operators import have_operators
from sphericalvision.recipes.benchmark.tables import comparison_table, machine, save_measurements

__all__ = ["GROUPS", "benchmark"]

GROUPS = (
    "machine",
    "cameras",
    "convolutions",
    "network",
    "data",
    "variants",
    "sweep",
    "training",
    "processes",
    "predict",
)
"""Each is a module ``<group>`` beside this one with a function ``comparisons(config, device)``."""


def comparisons(group: str, config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """The comparisons of one group, each made when its turn comes.

    Raises:
        ArgumentError: there is no such group.
    """
    check_choice("groups", group, GROUPS)
    yield from import_module(f"sphericalvision.recipes.benchmark.{group}").comparisons(config, device)


def benchmark(config: DictConfig, folder: Path) -> list[Measurement]:
    """Measure the groups that ``config`` names; the tables go to ``folder``.

    Raises:
        ArgumentError: there is no such group, or nothing of that title.
    """
    for group in config.groups:
        check_choice("groups", group, GROUPS)
    wanted = _expression(config.only)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    device = choose_device(config.device)
    have_operators(device)
    facts = machine(device)
    for key, value in facts.items():
        console.print(f"{key}: {value}", highlight=False)
    rows: list[Measurement] = []
    titles: list[str] = []
    for group in config.groups:
        for comparison in comparisons(group, config, device):
            if not wanted.search(comparison.title):
                titles.append(comparison.title)
                continue
            with console.status(comparison.title):
                measured = measure(comparison, config.seconds, device, peaks=peaks_of(rows))
            comparison_table(measured).print()
            rows += measured
            written = save_measurements(
                folder, rows, facts
            )  # after each, so that an interruption loses little
    if not rows:
        raise ArgumentError(f"only: expected a part of a title, got {config.only!r}; there are {titles}")
    for path in written:
        print(path)
    return rows


def _expression(only: str | None) -> re.Pattern[str]:
    try:
        return re.compile(only or "")
    except re.error as error:
        raise ArgumentError(f"only: expected a regular expression, got {only!r}: {error}") from error
