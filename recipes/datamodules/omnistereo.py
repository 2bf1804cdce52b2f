# SPDX-License-Identifier: Apache-2.0
"""OmniThings and its kin as training, validation and test data, without what of them cannot be read."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError
from sphericalvision.data import OmniStereoDataset, PhotometricAugmentation, RandomShift
from sphericalvision.data.augmentation.transforms import Compose
from sphericalvision.data.sample_view import ToView
from sphericalvision.recipes.app.kinds import Text
from sphericalvision.recipes.datamodules.data_module import Sample
from sphericalvision.recipes.datamodules.depth_data_module import DepthDataModule, Entries


class OmniStereoDataModule(DepthDataModule):
    """OmniThings and its kin from disk, split and augmented as in the paper.

    ``conf/data/omnistereo.yaml`` explains its keys.
    """

    of_training = ("seed", "augment", "shift")

    def __init__(
        self,
        root: Text,
        dataset: str = "omnithings",
        protocol: str = "paper",
        release: Literal["png", "tiff"] | None = None,
        missing: Literal["error", "skip"] = "error",
        augment: bool = True,
        shift: Annotated[float, Ge(0)] = 0.5,
        train_split: str = "train",
        val_split: str = "val",
        test_split: str = "test",
        batch_size: int = 4,
        num_workers: int = 4,
        seed: int = 0,
        entries: Entries = None,
        on_error: Literal["stop", "skip"] = "stop",
    ) -> None:
        self.entries = entries
        super().__init__(batch_size, num_workers, seed)
        self.on_error = on_error
        self.skipping: list[SkipDamaged] = []
        self.splits = {"train": train_split, "val": val_split, "test": test_split}
        self.augment, self.shift = augment, shift
        self.options: dict[str, Any] = {
            "root": root,
            "dataset": dataset,
            "protocol": protocol,
            "release": release,
            "missing": missing,
        }

    def dataset(self, split: str) -> Dataset[Sample]:
        """Frames of one split, augmented in "train"."""
        learned = split == "train"
        stages: list[Callable[[Sample], Sample]] = []
        if learned and self.augment:
            stages = [PhotometricAugmentation(), *([RandomShift(self.shift)] if self.shift else [])]
        return self._read(split, stages, counts=learned)

    def plain_train_dataset(self) -> Dataset[Sample]:
        """Training frames as they are on disk."""
        return self._read("train", [], counts=False)

    def left_out(self) -> list[str]:
        """Sentences about frames that could not be read and were skipped."""
        return [sentence for samples in self.skipping if (sentence := samples.left_out()) is not None]

    def _read(self, split: str, stages: list[Callable[[Sample], Sample]], counts: bool) -> Dataset[Sample]:
        frames = self.read(split, *stages, ToView(self.view))
        if self.on_error == "stop":
            return frames
        self.skipping.append(SkipDamaged(frames, counts))
        return self.skipping[-1]

    def read(self, split: str, *stages: Callable[[Sample], Sample]) -> OmniStereoDataset:
        """Frames of one split through transforms of one's own.

        Raises:
            ArgumentError: the set has another scale than the network.
        """
        transform = Compose(*stages)
        frames = OmniStereoDataset(split=self.splits[split], transform=transform, **self.options)
        min_depth = self.min_depth
        if abs(frames.min_depth / min_depth - 1) > 0.02:
            raise ArgumentError(
                f"data.root: {self.options['root']} has the minimum depth {frames.min_depth:g} m "
                f"({frames.release}), the network {min_depth:g} m; set "
                f"model.min_depth={frames.min_depth:g} to work at the scale of the set"
            )
        return frames


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
            neighbor = (index + step) % len(self)
            if self.damaged[neighbor]:
                continue
            try:
                sample = self.dataset[neighbor]
            except UNREADABLE:
                self.damaged[neighbor] = True
                continue
            return sample if step == 0 or self.counts else _without_truth(sample)
        raise FileFormatError(f"data: none of {len(self)} frames can be read. The first: {self._reason(0)}")

    def left_out(self) -> str | None:
        """A sentence about the samples that could not be read so far; None if all could."""
        damaged = self.damaged.nonzero()[:, 0].tolist()
        if not damaged:
            return None
        return (
            f"{len(damaged)} of {len(self)} frames were left out (data.on_error=skip). "
            f"The first: {self._reason(damaged[0])}"
        )

    def _reason(self, index: int) -> str:
        try:
            _ = self.dataset[index]
        except UNREADABLE as error:
            return str(error)
        return f"sample {index}, which can be read now"


def _without_truth(sample: Sample) -> Sample:
    """The sample with nothing valid in it."""
    return {
        key: torch.zeros_like(value) if isinstance(value, Tensor) and key.endswith("valid") else value
        for key, value in sample.items()
    }
