# SPDX-License-Identifier: Apache-2.0
"""Going on where files of a data set cannot be read, and saying at the end how many these were."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.core import FileFormatError, MissingFileError

__all__ = ["SkipDamaged"]

Sample = dict[str, Any]

UNREADABLE = (FileFormatError, MissingFileError, OSError)


class SkipDamaged(Dataset[Sample]):
    """The samples of a data set; where one cannot be read stands the next one that can.

    Args:
        dataset: samples by index.
        counts: whether a sample counts in the place of another, as in training. Where each is measured once, nothing
            in it is valid then, so that the number of samples stays and no metric sees it.
    """

    def __init__(self, dataset: Dataset[Sample], counts: bool) -> None:
        self.dataset, self.counts = dataset, counts
        # In shared memory: processes of a loader mark what they cannot read, and this one tells.
        self.damaged = torch.zeros(len(self), dtype=torch.bool).share_memory_()

    def __len__(self) -> int:
        return len(self.dataset)  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> Sample:
        for step in range(len(self)):
            place = (index + step) % len(self)
            if self.damaged[place]:
                continue
            try:
                sample = self.dataset[place]
            except UNREADABLE:
                self.damaged[place] = True
                continue
            return sample if step == 0 or self.counts else _without_truth(sample)
        raise FileFormatError(f"data: none of {len(self)} frames can be read. The first: {self._reason(0)}")

    def left_out(self) -> str | None:
        """A sentence about the samples that could not be read so far; None if all could."""
        places = self.damaged.nonzero()[:, 0].tolist()
        if not places:
            return None
        return (
            f"{len(places)} of {len(self)} frames were left out (data.on_error=skip). "
            f"The first: {self._reason(places[0])}"
        )

    def _reason(self, place: int) -> str:
        try:
            _ = self.dataset[place]
        except UNREADABLE as error:
            return str(error)
        return f"sample {place}, which can be read now"


def _without_truth(sample: Sample) -> Sample:
    """The sample with nothing valid in it."""
    return {
        key: torch.zeros_like(value) if isinstance(value, Tensor) and key.endswith("valid") else value
        for key, value in sample.items()
    }
