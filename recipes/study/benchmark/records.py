# SPDX-License-Identifier: Apache-2.0
"""What was measured, a file for each track and method, written anew after each frame: nothing is done twice."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sphericalvision.io.files import atomic_write
from sphericalvision.recipes.study.training import write_json

__all__ = ["GENERATION", "Record"]

GENERATION = 1
"""Raised whenever a frame would be scored otherwise, so that old records are not taken."""


class Record:
    """Scores of one method on the frames of one track, and the estimate that is drawn.

    Args:
        folder: of the benchmark; nothing is kept without one.
        track: name of the track.
        method: name of the method.
        key: whatever the scores depend on; what was measured under another one is forgotten.

    Examples:
        >>> record = Record(None, "room", "constant", {"level": 6})
        >>> record.add("room-1", {"MAE": 2.0})
        >>> record.scores
        {'room-1': {'MAE': 2.0}}
    """

    def __init__(self, folder: Path | None, track: str, method: str, key: dict[str, Any]) -> None:
        self.path = None if folder is None else folder / "records" / track / f"{method}.json"
        self.key = json.loads(json.dumps({"generation": GENERATION, **key}))
        self.scores: dict[str, Any] = {}
        self.cost: dict[str, Any] | None = None
        if self.path is not None and self.path.is_file():
            kept = json.loads(self.path.read_text())
            if kept["key"] == self.key:
                self.scores, self.cost = kept["frames"], kept["cost"]

    def add(self, frame: str, scores: dict[str, Any], cost: dict[str, Any] | None = None) -> None:
        """Add a frame and write the file."""
        self.scores[frame] = scores
        self.cost = self.cost if cost is None else cost
        if self.path is not None:
            write_json(self.path, {"key": self.key, "cost": self.cost, "frames": self.scores})

    def draw(self, index: Tensor) -> None:
        """Keep the estimate ``(V,)`` of the frame that is drawn."""
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.path.with_suffix(".npz")) as temporary:
                np.savez_compressed(temporary, index=index.numpy().astype(np.float16))

    def drawn(self) -> Tensor | None:
        """The estimate ``(V,)`` of the frame that is drawn, if there is one."""
        path = None if self.path is None else self.path.with_suffix(".npz")
        if path is None or not path.is_file():
            return None
        with np.load(path) as stored:
            return torch.from_numpy(stored["index"]).float()
