# SPDX-License-Identifier: Apache-2.0
"""Measurements of one method on one set of frames, kept as a file: nothing is measured twice."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sphericalvision.core import FileFormatError
from sphericalvision.io.files import atomic_write, write_bytes

Errors = dict[str, Any]
"""Nested dictionaries of numbers by protocol and name; None where nothing counts."""

INTERVAL = 2.0
"""Seconds between two writings of a record: what being killed may cost."""


class Record:
    """Errors of one method, frame by frame, and the estimates of the frames that are drawn.

    Args:
        path: of the JSON; estimates are in an ``.npz`` of the same name; nothing is kept without one.
        key: whatever the errors depend on; what was measured under another one, or is damaged, is forgotten.

    Attributes:
        frames: name of a frame -> its errors.
        drawn: name of a frame that is drawn -> index ``(V,)``, NaN where the method says nothing.
        cost: what the method takes, if somebody has counted.

    Examples:
        >>> record = Record()
        >>> record.add("room-1", {"paper": {"MAE": 2.0}})
        >>> record.add("room-2", {"paper": {"MAE": None}})
        >>> record.means
        {'paper': {'MAE': 2.0}}
    """

    def __init__(self, path: Path | None = None, key: Mapping[str, Any] | None = None) -> None:
        self.path, self.key = path, json.loads(json.dumps(key))
        self.frames: dict[str, Errors] = {}
        self.drawn: dict[str, Tensor] = {}
        self.cost: dict[str, Any] | None = None
        self._saved = time.monotonic()
        if path is None or not path.is_file():
            return
        try:
            content = read_json(path)
            if content["key"] == self.key:
                with np.load(path.with_suffix(".npz")) as stored:
                    self.drawn = {name: torch.from_numpy(stored[name]).float() for name in stored.files}
                self.frames, self.cost = content["frames"], content["cost"]
        except Exception:  # damaged, so it is measured again; numpy raises nearly anything
            self.drawn = {}

    def has(self, name: str, drawn: bool = False) -> bool:
        """Tell whether a frame was measured, and its estimate is there if it is to be ``drawn``."""
        return name in self.frames and (not drawn or name in self.drawn)

    def add(self, name: str, errors: Errors, drawn: Tensor | None = None) -> None:
        """Add a frame, and the estimate of one that is drawn."""
        self.frames[name] = errors
        if drawn is not None:
            self.drawn[name] = drawn.detach().half().float().cpu()  # as it is kept

    def save(self, at_once: bool = True) -> None:
        """Write the files; not ``at_once``: unless that was done a moment ago."""
        if self.path is None or (not at_once and time.monotonic() < self._saved + INTERVAL):
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        arrays = {name: index.numpy().astype(np.float16) for name, index in self.drawn.items()}
        with atomic_write(self.path.with_suffix(".npz")) as temporary:
            np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]
        write_json(self.path, {"key": self.key, "cost": self.cost, "frames": self.frames})
        self._saved = time.monotonic()

    def only(self, names: Iterable[str]) -> Record:
        """This record with some of its frames alone, in their order, to be read; the files stay as they are."""
        self.frames = {name: self.frames[name] for name in names if name in self.frames}
        return self

    @property
    def means(self) -> Errors:
        """Means over frames; see ``mean_errors``."""
        return mean_errors(self.frames.values())


def mean_errors(frames: Iterable[Errors]) -> Errors:
    """Means of nested dictionaries of numbers; None does not count, and stays where no frame has a number.

    Examples:
        >>> mean_errors([{"all": {"MAE": 1.0}}, {"all": {"MAE": 3.0}}, {"all": {"MAE": None}}])
        {'all': {'MAE': 2.0}}
    """
    items = list(frames)
    means: Errors = {}
    for key in dict.fromkeys(key for item in items for key in item):
        values = [item[key] for item in items if item.get(key) is not None]
        if values and isinstance(values[0], Mapping):
            means[key] = mean_errors(values)
        else:
            means[key] = math.fsum(values) / len(values) if values else None
    return means


def read_json(path: Path) -> dict[str, Any]:
    """Read a file of ``write_json``.

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
    write_bytes(path, (json.dumps(content, indent=2) + "\n").encode())
