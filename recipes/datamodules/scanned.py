# SPDX-License-Identifier: Apache-2.0
"""Real captures with the points of a scanner as training, validation and test data."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import torch
from annotated_types import Ge, Len
from torch.utils.data import Dataset

from sphericalvision.cameras.robot_frame import read_pose
from sphericalvision.capture.sources.image_files import ImageFiles
from sphericalvision.core import ArgumentError, check_file
from sphericalvision.data import PhotometricAugmentation
from sphericalvision.data.augmentation.transforms import Compose
from sphericalvision.data.sample_view import ToView
from sphericalvision.data.scanned.deep360 import Deep360Dataset
from sphericalvision.data.scanned.helvipad import PUBLISHED, HelvipadDataset
from sphericalvision.data.scanned.kitti360 import Kitti360Dataset
from sphericalvision.data.scanned.omnipus import OmniPusDataset
from sphericalvision.data.scanned.own import OwnScans
from sphericalvision.data.scanned.scanned_frames import ScannedFrames
from sphericalvision.data.scanned.spires import SpiresDataset
from sphericalvision.data.scanned.widedepth import WideDepthDataset
from sphericalvision.recipes.app.captures import CaptureFields
from sphericalvision.recipes.app.kinds import Count, Fraction, Positive, Text
from sphericalvision.recipes.datamodules.data_module import Sample
from sphericalvision.recipes.datamodules.depth_data_module import DepthDataModule, Entries

Transform = Callable[[Sample], Any]
Sequences = Annotated[list[str], Len(1)] | None


@dataclass(eq=False, repr=False, kw_only=True)
class ScannedDataModule(DepthDataModule):
    """Frames with the points of a scanner; a set's own class says what a split is."""

    entries: Entries = None
    truth_height: Count = 160
    augment: bool = True

    of_training = ("seed", "augment")
    max_depth: ClassVar[float] = 80.0
    """Metres up to which AbsRel and d<1.25 count where no other limit is given, whatever frames are called."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._read: list[ScannedFrames] = []

    @property
    def usual_panorama(self) -> tuple[int, int]:
        """(height, width) of panoramas of depth for networks that are not on panoramas."""
        return self.truth_height, 2 * self.truth_height

    def frames(self, split: str, height: int, transform: Transform) -> ScannedFrames:
        """The frames of "train", "val" or "test". Every subclass implements it."""
        raise NotImplementedError(f"{type(self).__name__}.frames")

    def dataset(self, split: str) -> Dataset[Sample]:
        """Frames of one split, with other colours in "train"."""
        return self._made(split, split == "train" and self.augment)

    def plain_train_dataset(self) -> Dataset[Sample]:
        """Training frames as they are on disk."""
        return self._made("train", False)

    def left_out(self) -> list[str]:
        """Sentences about frames that lack something."""
        return list(dict.fromkeys(sentence for frames in self._read for sentence in frames.left_out))

    def _made(self, split: str, augmented: bool) -> ScannedFrames:
        height = (self.view.panorama or self.usual_panorama)[1] // 2
        stages = [PhotometricAugmentation()] if augmented else []
        frames = self.frames(split, height, Compose(*stages, ToView(self.view)))
        self._read.append(frames)
        return frames


@dataclass(eq=False, repr=False, kw_only=True)
class HelvipadDataModule(ScannedDataModule):
    """Helvipad by its splits."""

    root: Text
    augmented: bool = False

    published: ClassVar[Mapping[str, tuple[float, ...]]] = PUBLISHED

    def frames(self, split: str, height: int, transform: Transform) -> HelvipadDataset:
        """Frames of a split."""
        return HelvipadDataset(self.root, split, height, transform, self.augmented and split == "train")


@dataclass(eq=False, repr=False, kw_only=True)
class Deep360DataModule(ScannedDataModule):
    """Deep360 by its splits."""

    root: Text

    def frames(self, split: str, height: int, transform: Transform) -> Deep360Dataset:
        """Frames of a split."""
        return Deep360Dataset(self.root, split, height, transform)


@dataclass(eq=False, repr=False, kw_only=True)
class _SequencesDataModule(ScannedDataModule):
    """A set without splits: sequences are named for each."""

    root: Text
    train: Sequences = None
    val: Sequences = None
    test: Sequences = None

    def sequences(self, split: str) -> list[str]:
        """The sequences of a split."""
        chosen = {"train": self.train, "val": self.val, "test": self.test}[split]
        if chosen is None:
            raise ArgumentError(
                f"data.{split}: this set has no splits of its own; name sequences, data.{split}=[a,b]"
            )
        return chosen


@dataclass(eq=False, repr=False, kw_only=True)
class Kitti360DataModule(_SequencesDataModule):
    """Windows over time of KITTI-360."""

    window: Annotated[int, Ge(2)] = 3
    spacing: Positive = 1.0

    def frames(self, split: str, height: int, transform: Transform) -> Kitti360Dataset:
        """Windows of a split."""
        return Kitti360Dataset(self.root, self.sequences(split), self.window, self.spacing, height, transform)


@dataclass(eq=False, repr=False, kw_only=True)
class SpiresDataModule(_SequencesDataModule):
    """Oxford Spires."""

    tolerance: Positive = 0.02

    def frames(self, split: str, height: int, transform: Transform) -> SpiresDataset:
        """Frames of a split."""
        return SpiresDataset(self.root, self.sequences(split), height, transform, self.tolerance)


@dataclass(eq=False, repr=False, kw_only=True)
class WideDepthDataModule(_SequencesDataModule):
    """WideDepth, all scenes of which are for the test where none are named."""

    field_of_view_deg: Literal[120, 140, 165, 195] = 195
    baseline_mm: Literal[20, 65, 120, 200, 300] = 65
    stereo: Literal["horizontal", "vertical", "both"] = "horizontal"
    calibration: Text | None = None

    def frames(self, split: str, height: int, transform: Transform) -> WideDepthDataset:
        """Scenes of a split."""
        scenes = None if split == "test" and self.test is None else self.sequences(split)
        chosen = (self.field_of_view_deg, self.baseline_mm, self.stereo, self.calibration)
        return WideDepthDataset(self.root, scenes, height, transform, *chosen)


@dataclass(eq=False, repr=False, kw_only=True)
class OmniPusDataModule(ScannedDataModule):
    """OmniPus; its test cases validate, too, as it has no others."""

    root: Text

    def frames(self, split: str, height: int, transform: Transform) -> OmniPusDataset:
        """Frames of a split."""
        section = "train" if split == "train" else "test"
        return OmniPusDataset(self.root, section, height, transform)


@dataclass(eq=False, repr=False, kw_only=True)
class OwnScansDataModule(CaptureFields, ScannedDataModule):
    """A capture of one's own with a scan for each frame: all frames for the test, a share at the end for validation.

    The capture has the keys of ``CaptureFields``.
    """

    points: Text
    lidar_pose: Text | None = None
    tolerance: Positive = 0.02
    point_columns: Count | None = None
    val_share: Fraction = 0.2
    frames_named: list[int | str] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        capture = self.capture_with(frames=self.frames_named, tolerance=self.tolerance)
        source = capture.open()
        if not isinstance(source, ImageFiles) or any("" in files for files in source.moments.values()):
            raise ArgumentError(
                "data.images: scans lie beside image files, one for each camera and frame; expected such, not videos, "
                "bags or pictures of all views"
            )
        capture.restrict(source)
        self.source = source

    def frames(self, split: str, height: int, transform: Transform) -> OwnScans:
        """All frames, or those that train or validate.

        Raises:
            ArgumentError: too few frames for both.
        """
        pose = torch.eye(4)
        if self.lidar_pose is not None:
            path = check_file(self.lidar_pose, "the pose of the scanner, data.lidar_pose,")
            pose = read_pose(path, "data.lidar_pose")
        files = self.source.moments
        scans = OwnScans(
            files, self.source.rig, self.points, pose, height, transform, self.tolerance, self.point_columns
        )
        num_train = len(scans) - max(round(self.val_share * len(scans.names)), int(self.val_share > 0))
        splits = {"train": scans.names[:num_train], "val": scans.names[num_train:]}
        scans.names = splits.get(split, scans.names)
        if not scans.names:
            raise ArgumentError(
                f"data.val_share: {self.val_share:g} of {len(files)} frames leaves none to {split}"
            )
        return scans
