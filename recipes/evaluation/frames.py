# SPDX-License-Identifier: Apache-2.0
"""Sets of frames that methods are evaluated on."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Protocol

from rich.progress import track

__all__ = ["Batch", "FrameSet", "SampleFrames"]

Batch = Any
"""Some frames: whatever methods find images, and a measure the truth in; mostly samples that are put together."""


class FrameSet(Protocol):
    """Frames by name, made when they are asked for.

    Attributes:
        name: of the set, in files and tables.
        names: of all frames, in order.
        drawn: names of those whose estimates are kept for pictures.
    """

    name: str
    names: Sequence[str]
    drawn: Collection[str]

    @property
    def key(self) -> Mapping[str, Any]:
        """What the frames depend on, as JSON has it."""

    def batches(self, names: Sequence[str]) -> Iterator[tuple[Sequence[str], Batch]]:
        """Some of the frames in batches, each with the names of its frames."""


class SampleFrames:
    """Samples, named by their numbers; shows its progress.

    Args:
        load: makes batches of the samples of some numbers, put together as ``collate_samples`` does.
        count: of all samples.
        name: of the set, and of its progress.
        drawn: numbers of the frames that are drawn.
        key: what the frames depend on.
    """

    def __init__(
        self,
        load: Callable[[Sequence[int]], Collection[dict[str, Any]]],
        count: int,
        name: str = "evaluating",
        drawn: Sequence[int] = (),
        key: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self.load, self.name, self.key = load, name, key
        self.names = [str(number) for number in range(count)]
        self.drawn = {str(number) for number in drawn}

    def batches(self, names: Sequence[str]) -> Iterator[tuple[Sequence[str], Batch]]:
        """The samples of some names, in batches."""
        done = 0
        loader = self.load([int(name) for name in names])
        for batch in track(loader, self.name, total=len(loader)):
            number = len(batch["valid"])
            yield names[done : done + number], batch
            done += number
