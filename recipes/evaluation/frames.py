# SPDX-License-Identifier: Apache-2.0
"""Sets of frames that methods are evaluated on."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

from rich.progress import track
from torch.utils.data import Dataset, Subset

if TYPE_CHECKING:
    from sphericalvision.recipes.datamodules.base import SampleDataModule


__all__ = ["Batch", "BatchFrames", "FrameSet", "SampleFrames"]

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
    """Samples of a data module, named by their numbers; shows its progress.

    Args:
        data: that makes the loader.
        samples: the frames.
        name: of the set, and of its progress.
        drawn: numbers of the frames that are drawn.
        key: what the frames depend on.
    """

    def __init__(
        self,
        data: SampleDataModule,
        samples: Dataset[Any],
        name: str = "evaluating",
        drawn: Sequence[int] = (),
        key: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self.data, self.samples, self.name, self.key = data, samples, name, key
        self.names = [str(number) for number in range(len(samples))]  # type: ignore[arg-type]
        self.drawn = {str(number) for number in drawn}

    def batches(self, names: Sequence[str]) -> Iterator[tuple[Sequence[str], Batch]]:
        """The samples, put together as the data module does."""
        done = 0
        loader = self.data.loader(Subset(self.samples, [int(name) for name in names]))
        for batch in track(loader, self.name, total=len(loader)):
            number = len(batch["valid"])
            yield names[done : done + number], batch
            done += number


class BatchFrames:
    """Frames of batches that are there already, named by their numbers.

    Args:
        batches: samples that are put together, each of which is given whole.
    """

    name = "batches"
    key: Mapping[str, Any] = MappingProxyType({})
    drawn: Collection[str] = ()

    def __init__(self, *batches: dict[str, Any]) -> None:
        self.given = batches
        self.names = [str(number) for number in range(sum(len(batch["valid"]) for batch in batches))]

    def batches(self, names: Sequence[str]) -> Iterator[tuple[Sequence[str], Batch]]:
        """All batches, whatever is asked for."""
        done = 0
        for batch in self.given:
            number = len(batch["valid"])
            yield self.names[done : done + number], batch
            done += number
