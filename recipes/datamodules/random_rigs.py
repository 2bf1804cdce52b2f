# SPDX-License-Identifier: Apache-2.0
"""Scenes of all kinds through rigs of all kinds, as training, validation and test data."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch.utils.data import Dataset

from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.core import ArgumentError
from sphericalvision.data import RotateFivefold
from sphericalvision.data.augmentation.fivefold import Mirror
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.app.kinds import Size
from sphericalvision.recipes.datamodules.base import PreparedSamples, Sample
from sphericalvision.recipes.datamodules.entries import check_on_icospheres
from sphericalvision.recipes.datamodules.scenes import RenderedDataModule
from sphericalvision.scenes import World, WorldSamples
from sphericalvision.scenes.cache import ArrayCache
from sphericalvision.scenes.draws import by_purpose
from sphericalvision.scenes.random_rigs import LevelOrRandomRigs
from sphericalvision.scenes.world import NATURAL_MIN_DEPTH

__all__ = ["RandomRigDataModule"]


class WithFixedInputs(Dataset[Sample]):
    """Samples, and what a network computes of them before anything that is trained.

    Args:
        scenes: the samples.
        net: whose ``fixed_inputs`` are wanted; its state says which folder below that of the samples they are in.
    """

    def __init__(self, scenes: WorldSamples, net: DepthNetwork) -> None:
        self.scenes, self.net = scenes, net
        folder = scenes.cache.folder
        self.cache = ArrayCache(None if folder is None else folder / f"fixed-{fingerprint(net)}")

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> Sample:
        sample = self.scenes[index]
        fixed = self.cache.get(sample["frame"], lambda: self._compute(sample))
        return {**sample, "fixed": fixed} if fixed else sample

    def _compute(self, sample: Sample) -> dict[str, torch.Tensor]:
        images, seen = sample["images"][None], sample["seen"][None]
        inputs = self.net.fixed_inputs(images, sample["rig"], seen)
        return {name: values[0] for name, values in inputs.items()}


@dataclass(eq=False, repr=False, kw_only=True)
class RandomRigDataModule(PreparedSamples, RenderedDataModule):
    """Samples for a network that is to serve any rig: scene, rig and disturbances follow from the seed.

    Some rigs are level rings of four fisheyes, the common case; the others are ``random_rig``. Some samples are
    disturbed as by cheap cameras (``CameraDisturbance``), with poses a little off, and some are too bright. Some rigs
    stand on something that they see, which is mostly not masked. Most scenes are under a sky that is not theirs, black,
    white, of any colour or cloudy, and a few have no lamps: so meshes and photographs of other people look. Images are
    prepared as in use, and averaged where they are finer than the icosphere.

    A batch of training has rigs of as many cameras each. In training, the world is turned by random multiples of 72
    degrees, and half of the samples are mirrored.
    The cache keeps, too, what a network computes of samples before anything that is trained.

    Args:
        world: what comes how often, and faults, as ``conf/world/random_rigs.yaml``.
        image_size: height and width of the cameras.

    References:
        WMGStereo (2025), "What makes good synthetic training data for zero-shot stereo matching?", for diversity
        before realism.
    """

    world: dict[str, Any]
    image_size: Size = (256, 256)

    augmentation = (Mirror(0.5), RotateFivefold())
    made_before = ("val",)
    net: ClassVar[DepthNetwork | None] = None

    def bind_network(self, net: Any, *more: str, depth_level: int | None = None) -> None:
        """Give samples on the network's icospheres, and keep what it computes of them before anything trained.

        Raises:
            ArgumentError: the network is not one on icospheres, or its nearest hypothesis is not 0.55 m.
        """
        check_on_icospheres(net, "random rigs")
        if abs(net.min_depth / NATURAL_MIN_DEPTH - 1) > 1e-6:
            raise ArgumentError(
                f"model.min_depth: random rigs are in scenes of natural size, for 0.55 m, got {net.min_depth}"
            )
        super().bind_network(net, depth_level=depth_level)
        self.net = net  # type: ignore[misc]

    def __post_init__(self) -> None:
        super().__post_init__()
        values = dict(self.world)
        size = int(self.image_size[0]), int(self.image_size[1])
        self.drawn_world = World.of(
            values,
            rig=LevelOrRandomRigs(values.pop("level_rigs"), size),
            prepare=Preparation(self.photometric).of_images,
            samples_per_pixel=self.samples_per_pixel,
            draws=by_purpose,
        )
        self.numbers_of_cameras: dict[int, int] = {}

    def plain(self, split: str) -> Dataset[Sample]:
        """Samples of one split as they are kept."""
        view = replace(self.view, antialias=True)
        scenes = WorldSamples(self.drawn_world, view, self.seeds(split), self.cache_dir)
        if self.net is None or self.cache_dir is None:  # what is not kept is the step's work, on its device
            return scenes
        return WithFixedInputs(scenes, self.net)

    def group(self, index: int) -> int:
        """The number of cameras of a training sample: drawing a rig takes milliseconds, and is done once a seed."""
        if index not in self.numbers_of_cameras:
            frame = self.drawn_world.frame(self.seeds("train")[index])
            self.numbers_of_cameras[index] = len(frame.true_rig)
        return self.numbers_of_cameras[index]


def fingerprint(net: DepthNetwork) -> str:
    """Eight letters for the parts of a network that are not trained."""
    shape = {key: value for key, value in net.hyperparameters.items() if key in (net.fixed_by or (key,))}
    fixed = [f"{type(net).__name__} {shape}".encode()]
    fixed += [
        name.encode() + parameter.detach().cpu().numpy().tobytes()
        for name, parameter in net.named_parameters()
        if not parameter.requires_grad
    ]
    return hashlib.sha256(b"".join(fixed)).hexdigest()[:8]
