# SPDX-License-Identifier: Apache-2.0
"""The table of a multi-run: what each run changed, and what came out, written when the last run has ended."""

import json
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from sphericalvision.recipes.app.errors import FAILURE


class MultirunTable(Callback):
    """A callback of Hydra's: prints the table of a multi-run and writes it, ``sweep.md`` and ``sweep.json``."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Gather the folders of the runs."""
        # Hydra makes its callbacks before the task has imported torch, which takes care of when that happens.
        from sphericalvision.recipes.evaluation.records import write_json
        from sphericalvision.recipes.evaluation.tables import Table

        folder = Path(config.hydra.sweep.dir).absolute()
        rows = multirun_rows(folder)
        if not rows:
            return
        columns = list(dict.fromkeys(key for row in rows for key in row))
        table = Table("", columns, [[row.get(column, "") for column in columns] for row in rows])
        table.save(folder / "sweep", ".md")
        write_json(folder / "sweep.json", rows)
        print(f"\n{table.markdown()}\nTable of the sweep: {folder / 'sweep.md'}")


def multirun_rows(folder: Path) -> list[dict[str, Any]]:
    """A row for each run that has ended: its number, the words that differ between runs, its errors or its failure."""
    runs = []
    for path in folder.glob("*/.hydra/overrides.yaml"):
        run = path.parent.parent
        if values := _outcome(run):
            overrides = map(str, OmegaConf.load(path))
            runs.append((run.name, dict(word.split("=", 1) for word in overrides if "=" in word), values))
    runs.sort(key=lambda run: (len(run[0]), run[0]))
    keys = dict.fromkeys(key for _, overrides, _ in runs for key in overrides)
    varied = [key for key in keys if len({overrides.get(key) for _, overrides, _ in runs}) > 1]
    return [
        {"run": name, **{key: overrides.get(key, "") for key in varied}, **values}
        for name, overrides, values in runs
    ]


def _outcome(run: Path) -> dict[str, Any]:
    """The errors of a run in validation and test, or why it failed; nothing of one that has not ended."""
    if (failure := run / FAILURE).is_file():
        return {"outcome": f"failed: {' '.join(failure.read_text().split())}"}
    if not (validation := run / "validation.json").is_file():
        return {}
    (values,) = json.loads(validation.read_text()).values()
    if (test := run / "test.json").is_file():
        (errors,) = json.loads(test.read_text()).values()
        values |= {f"test {name}": value for name, value in errors.items()}
    return dict(values)
