# SPDX-License-Identifier: Apache-2.0
"""The table N/N, N/R, R/R of digits on the sphere, out of the runs of a sweep.

    python -m sphericalvision.recipes.digits_table runs=outputs/digits/2026-01-31_12-00-00

N stands for upright and R for randomly rotated digits, first in training and then in the test.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

from omegaconf import DictConfig, OmegaConf

from sphericalvision.core import ArgumentError
from sphericalvision.models.classifier import SphereClassifier
from sphericalvision.models.sphere_blocks import SPHERE_NETWORKS
from sphericalvision.recipes.evaluation.records import write_json
from sphericalvision.recipes.evaluation.tables import Cell, Row, Table

__all__ = ["DigitsRun", "digits_table", "gather", "table"]

LETTERS = {"upright": "N", "rotated": "R"}
COLUMNS = ("N/N", "N/R", "R/R", "R/N")
NAMES = {
    "crown": "CrownConv2d",
    "hex": "HexConv2d",
    "hexgroup": "HexGroupConv2d",
    "sphere": "SphereConv2d",
    "planar": "nn.Conv2d",
}


class DigitsRun(NamedTuple):
    """One training: network, parameters, how its digits were turned, and the test accuracies by orientation."""

    network: str
    parameters: int
    orientation: str
    accuracies: dict[str, float]


def gather(folder: Path) -> list[DigitsRun]:
    """Read the finished runs in the folders of ``folder``.

    Raises:
        ArgumentError: there is none; the message says how to make them.
    """
    runs = []
    for path in sorted(folder.glob("*/test.json")):
        config = OmegaConf.load(path.with_name("config.yaml"))
        model = config.model
        net = SphereClassifier(model.network, model.level, model.num_classes, width=model.width)
        parameters = sum(parameter.numel() for parameter in net.parameters())
        (accuracies,) = json.loads(path.read_text()).values()
        runs.append(DigitsRun(model.network, parameters, config.data.orientation, accuracies))
    if not runs:
        raise ArgumentError(
            f"runs: no folder in {folder.resolve()} has a test.json; make them with sphericalvision-train --multirun "
            f"experiment=spherical_digits model.network={','.join(SPHERE_NETWORKS)} "
            "data.orientation=upright,rotated"
        )
    return runs


def table(runs: list[DigitsRun]) -> dict[str, dict[str, float]]:
    """Accuracies in percent by network and column, means over runs that differ in other things, such as seeds.

    Examples:
        >>> runs = [DigitsRun("hex", 10, "upright", {"upright": 90.0, "rotated": 50.0})]
        >>> table(runs)
        {'hex': {'parameters': 10, 'N/N': 90.0, 'N/R': 50.0}}
    """
    rows: dict[str, dict[str, float]] = {}
    for network in SPHERE_NETWORKS:
        mine = [run for run in runs if run.network == network]
        if not mine:
            continue
        rows[network] = {"parameters": mine[0].parameters}
        for column in COLUMNS:
            trained, tested = ({v: k for k, v in LETTERS.items()}[letter] for letter in column.split("/"))
            values = [run.accuracies[tested] for run in mine if run.orientation == trained]
            if values:
                rows[network][column] = sum(values) / len(values)
    return rows


def digits_table(config: DictConfig, folder: Path) -> dict[str, dict[str, float]]:
    """Gather the runs in ``config.runs``, print their table and save it in ``folder``, ``digits.md`` and ``.json``."""
    rows = table(gather(Path(config.runs)))
    cells: list[Row] = [
        [NAMES[network], f"{row['parameters']:,.0f}", *(percent(row.get(column)) for column in COLUMNS)]
        for network, row in rows.items()
    ]
    printed = Table("test accuracy in percent", ("convolution", "parameters", *COLUMNS), [cells])
    printed.print()
    printed.save(folder / "digits", ".md")
    write_json(folder / "digits.json", rows)
    print(f"Results are in {folder}")
    return rows


def percent(value: float | None) -> Cell | None:
    """A cell with one digit; None for what was not run."""
    return None if value is None else Cell(value, digits=1)
