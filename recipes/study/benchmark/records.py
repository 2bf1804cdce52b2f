# SPDX-License-Identifier: Apache-2.0
"""What was measured, a file for each track and method, written anew after each frame: nothing is done twice."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sphericalvision.core import FileFormatError
from sphericalvision.io.files import atomic_write
from sphericalvision.recipes.study.training import read_json, write_json

__all__ = ["GENERATION", "Record"]

GENERATION = 1
"""Raised whenever a frame would be scored otherwise, so that old records are not taken."""


class Record:
    """Scores of one method on the frames of one track, and the estimates that are drawn.

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
            with suppress(FileFormatError, KeyError):  # what is damaged is measured again
                kept = read_json(self.path)
                if kept["key"] == self.key:
                    self.scores, self.cost = kept["frames"], kept["cost"]

    def add(self, frame: str, scores: dict[str, Any], cost: dict[str, Any] | None = None) -> None:
        """Add a frame and write the file."""
        self.scores[frame] = scores
        self.cost = self.cost if cost is None else cost
        if self.path is not None:
            write_json(self.path, {"key": self.key, "cost": self.cost, "frames": self.scores})

    def has(self, frame: str, drawn: int | None = None) -> bool:
        """Whether a frame's scores are there, and the estimate of the one that is ``drawn``, by its number."""
        pictured = drawn is None or self.path is None or drawn in self.drawn()
        return frame in self.scores and pictured

    def only(self, frames: Iterable[str]) -> Record:
        """This record with the scores of these frames alone, to be read; the file stays as it is."""
        self.scores = {frame: self.scores[frame] for frame in frames if frame in self.scores}
        return self

    def draw(self, number: int, index: Tensor) -> None:
        """Keep the estimate ``(V,)`` of a frame that is drawn, by its number in the track."""
        if self.path is not None:
            arrays = {str(key): value.numpy().astype(np.float16) for key, value in self.drawn().items()}
            arrays[str(number)] = index.numpy().astype(np.float16)
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.path.with_suffix(".npz")) as temporary:
                np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]

    def drawn(self) -> dict[int, Tensor]:
        """The estimates ``(V,)`` of the frames that are drawn, by number; without a score those are of another key."""
        path = self.path.with_suffix(".npz") if self.path is not None and self.scores else None
        if path is None or not path.is_file():
            return {}
        with np.load(path) as stored:
            return {int(key): torch.from_numpy(stored[key]).float() for key in stored.files}
