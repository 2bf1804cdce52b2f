# SPDX-License-Identifier: Apache-2.0
"""A capture without truth as training data: what a trained network and a sweep say of it is what is learned."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from rich.progress import track
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.photographs import as_photographs
from sphericalvision.capture.predictor import check_number
from sphericalvision.capture.preparation.nearest import nearest_hypothesis
from sphericalvision.capture.preparation.preparation import AS_IT_IS, AUTO, Preparation
from sphericalvision.capture.sources.frames import Selection, Source
from sphericalvision.capture.sources.opening import spread_evenly
from sphericalvision.core import ArgumentError
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.app.captures import open_capture, with_own_body_masked
from sphericalvision.recipes.app.cli import console
from sphericalvision.recipes.app.kinds import Count, HalfAngle, Names, Number, Positive, Share, Text, Unit
from sphericalvision.recipes.app.schema import AtLeast
from sphericalvision.recipes.datamodules.base import Sample, SampleDataModule
from sphericalvision.recipes.datamodules.rehearsal import Rehearsal, random_disturbance
from sphericalvision.recipes.training.rig_tables import RigTables
from sphericalvision.scenes.world import HELD_OUT_SEED, NATURAL_MIN_DEPTH
from sphericalvision.sweep import (
    correlation_evidence,
    inverse_depth_from_index,
    semi_global_sweep,
    semi_global_tables,
)
from sphericalvision.sweep.consistency_share import consistency_share
from sphericalvision.sweep.semi_global import SemiGlobalTables

__all__ = ["CaptureDataModule"]

UNSURE, SURE = 0.5, 0.8
"""Confidence of the network below which it teaches nothing, and of the sweep from which that answers in its place."""
MOST_ROWS, RENDERED_ROWS = 512, 256
"""Of images that are kept, finer than an icosphere of level 6; and of those that are rendered."""
NUM_RENDERED = 100_000
"""Scenes that training draws from."""
COLORLESS = 0.01
"""Mean difference of colour channels, of the range [0, 1], below which a capture counts as grey."""


class Taught(NamedTuple):
    """A frame, and what is known of it without truth.

    Attributes:
        name: of the frame.
        images: camera name -> uint8 ``(3, h, w)``.
        inverse_depth: ``(V_depth,)`` what is to be learned, in the network's metres.
        valid: ``(V_depth,)`` where it is.
        correlation: ``(M, V)`` of the better half of the cameras at tried hypotheses, 0 to 255; kept to judge by.
        known: ``(M, V)`` whether two cameras see the point.
        share: photo-consistency of what the network says, of winner-takes-all's.
    """

    name: str
    images: dict[str, Tensor]
    inverse_depth: Tensor
    valid: Tensor
    correlation: Tensor
    known: Tensor
    share: float


class CaptureDataModule(SampleDataModule):
    """Frames of a capture, some to learn from and some to judge by, and rendered scenes seen through its rig.

    What is to be learned of a frame is what the network, as it is at first, says of the undisturbed images where it
    is sure, and the semi-global sweep where that is sure and the network is not. Training shows it the same images
    disturbed: vignetting, exposure, noise, blur, poses a little off. A share of the samples are rendered scenes with
    their truth, through the same rig and the same disturbances, so that what was learned before is kept and suits this
    rig.

    Lengths are scaled so that the nearest hypothesis is that of the network: scaling a rig and everything around it
    changes no image. Frames are read once and kept, at most 512 rows of each image.

    Args:
        images: pattern of images or videos, or folder, as ``sphericalvision-predict`` takes it.
        calibration: file, or folder; the one beside the images when not given.
        frames: names or numbers of frames of image files.
        start: position of the first frame.
        stop: position before which to stop.
        every: 2 takes every second frame.
        num_frames: frames that are used, spread evenly.
        held_out_every: every fifth frame is kept to judge by.
        cameras: names of the cameras to use, in order.
        masks: pattern of masks, white where usable; ``"auto"`` finds the body that carries the rig in the frames.
        translation_unit: of ``poses.txt``.
        max_angle_deg: half the field of view, where the calibration does not say it.
        min_depth: nearest hypothesis in metres; ``"auto"`` and ``"scene"`` as of ``Predictor``.
        trained_radius: rig radius that the network was trained with, metres.
        rendered: share of training samples that are rendered scenes.
        rendered_seed: of the first rendered scene.
        batch_size: samples in a batch: 1, as rigs differ.
        num_workers: processes that prepare samples.
        seed: of order and disturbances.
        **preparation: what is done to images, as of ``Preparation``; also to the disturbed ones, so that what is left
            of the disturbances is learned.
    """

    has_truth = False

    def __init__(
        self,
        images: Text,
        calibration: Text | None = None,
        frames: list[int | str] | None = None,
        start: Number = 0,
        stop: Count | None = None,
        every: Count = 1,
        num_frames: Annotated[int, AtLeast(2)] = 50,
        held_out_every: Annotated[int, AtLeast(2)] = 5,
        cameras: Names | None = None,
        masks: Text | None = None,
        translation_unit: Unit | None = None,
        max_angle_deg: HalfAngle | None = None,
        min_depth: Positive | Literal["auto", "scene"] = "auto",
        trained_radius: Positive = 0.2,
        rendered: Share = 0.5,
        rendered_seed: Number = 5_000_000,
        batch_size: int = 1,
        num_workers: int = 0,
        seed: int = 0,
        **preparation: bool,
    ) -> None:
        if batch_size != 1:
            raise ArgumentError(
                f"data.batch_size: expected 1, as disturbed rigs differ, got {batch_size}; set "
                "trainer.accumulate_grad_batches"
            )
        if rendered_seed + NUM_RENDERED > HELD_OUT_SEED:
            raise ArgumentError(
                f"data.rendered_seed: seeds from {HELD_OUT_SEED} are held out for the benchmark, and {NUM_RENDERED} "
                f"scenes follow this one; set {HELD_OUT_SEED - NUM_RENDERED} or less, got {rendered_seed}"
            )
        super().__init__(batch_size, num_workers, seed)
        self.images = images
        self.selection = Selection(start, stop, every)
        self.num_frames, self.held_out_every = num_frames, held_out_every
        self.min_depth, self.trained_radius = min_depth, trained_radius
        self.rendered, self.rendered_seed = rendered, rendered_seed
        self.preparation = Preparation(**preparation, own_body=masks == AUTO)
        keys = (cameras, masks, translation_unit, max_angle_deg, frames)
        self.source = open_capture(images, calibration or images, *keys)
        if len(self.source.rig) < 2:
            raise ArgumentError("data.cameras: expected two or more that see the same things, got one")
        self.names = self._chosen(self.source)
        self.taught: dict[str, Taught] = {}
        self.rig = self.source.rig
        self.net: DepthNetwork | None = None

    def _chosen(self, source: Source) -> list[str]:
        names = source.names(self.selection)
        if names is None:
            raise ArgumentError("data.images: expected a recording, not live cameras")
        if len(names) < 2:
            raise ArgumentError(
                f"data.images: expected two or more frames, some to learn from and some to judge by, got {len(names)}"
            )
        return spread_evenly(names, self.num_frames)

    @property
    def held_out(self) -> list[str]:
        """Names of the frames that judge."""
        middle = min(self.held_out_every // 2, len(self.names) - 1)
        return self.names[middle :: self.held_out_every]

    def serve(self, net: Any, *more: str, depth_level: int | None = None) -> None:
        """Give samples on the network's icospheres.

        Raises:
            ArgumentError: the network is not one on icospheres, or for another number of cameras.
        """
        if net.images != "sphere" or not isinstance(net.grid, Icosphere):
            raise ArgumentError(f"data: captures are for networks on icospheres, not {type(net).__name__}")
        check_number(net, self.rig)
        self.net = net

    def setup(self, stage: str) -> None:
        """Read the frames and let network and sweep say what they think, once."""
        if self.taught:
            return
        if self.net is None:
            raise ArgumentError("data: a network teaches what is in a capture; call serve(net) before setup")
        photographs = {}
        for frame in track(
            self.source.frames(Selection(), lambda name: name in self.names),
            "reading frames",
            total=len(self.names),
            console=console,
        ):
            if frame.images is None:
                raise frame.error  # type: ignore[misc]
            photographs[frame.name] = _kept(as_photographs(frame.images, self.source.rig))
        first = photographs[self.names[0]]
        rig = self.source.rig.resized({name: tuple(image.shape[-2:]) for name, image in first.items()})
        if self.preparation.own_body:
            rig = with_own_body_masked(rig, map(_floats, photographs.values()))
        self.near = self._nearest(rig, photographs)
        self.rig = rig.scaled(self.net.min_depth / self.near)
        teacher = _Teacher(self.net, self.rig)
        for name in track(self.names, "asking network and sweep", console=console):
            images = self.preparation.images(self.rig, _floats(photographs[name]))
            self.taught[name] = teacher(name, _kept(images))
        self.grey = float(all(_is_grey(images) for images in photographs.values()))

    def _nearest(self, rig: CameraRig, photographs: dict[str, dict[str, Tensor]]) -> float:
        assert self.net is not None
        nearest = nearest_hypothesis(self.min_depth, self.net, rig, self.trained_radius)
        if nearest.metres is not None:
            return nearest.metres
        return nearest.in_frames([_floats(photographs[name]) for name in spread_evenly(self.names, 3)], rig)

    @property
    def start_share(self) -> float:
        """Photo-consistency of the held-out frames by the network as it was at first."""
        shares = [self.taught[name].share for name in self.held_out]
        return sum(shares) / len(shares)

    def dataset(self, split: str) -> Dataset[Sample]:
        """Disturbed frames and rendered scenes in "train", the held-out frames as they are otherwise."""
        assert self.net is not None
        chosen = [name for name in self.names if (name in self.held_out) == (split != "train")]
        frames = _Frames([self.taught[name] for name in chosen], self.rig, self.net.level)
        if split != "train":
            return frames
        grid = self.net.grid
        assert isinstance(grid, Icosphere)
        natural = _smaller(self.rig.scaled(NATURAL_MIN_DEPTH / self.net.min_depth))
        scenes = Rehearsal(
            natural, self.net.level, grid.level, self.grey, NUM_RENDERED, self.rendered_seed, self.preparation
        )
        frames.disturbed, frames.preparation = self.grey, self.preparation
        return _Mixed(frames, scenes, self.rendered, self.net.min_depth / NATURAL_MIN_DEPTH)


class _Teacher:
    """What a network and a sweep say of undisturbed frames."""

    def __init__(self, net: DepthNetwork, rig: CameraRig) -> None:
        self.net, self.rig = net, rig
        self.to_sphere = ToSphere(net.level, 2, antialias=True)
        self.tables = RigTables(net).of(rig)
        self.hypotheses = (net.num_hypotheses, net.min_depth)
        self.coarse = Icosphere(max(net.level - 1, 0))
        self.sweep: SemiGlobalTables = semi_global_tables(rig, *self.hypotheses, net.level)

    @torch.no_grad()
    def __call__(self, name: str, images: dict[str, Tensor]) -> Taught:
        net, coarse = self.net, self.coarse
        on_sphere = self.to_sphere.images(_floats(images), self.rig)[None]
        seen = self.to_sphere.seen(self.rig)[None]
        training = net.training
        net.eval()
        said = net.predict(on_sphere, self.tables, seen)
        net.train(training)
        swept = semi_global_sweep(on_sphere, self.sweep, *self.hypotheses, coarse.level, seen=seen)
        _, correlation, cameras = correlation_evidence(on_sphere, self.sweep.sweep, seen).unbind(1)
        known = cameras >= 2
        place = net.index_at(said.index, coarse.vertices)[0] / (self.hypotheses[0] - 1)
        share = float(consistency_share(place, correlation, known))
        sure_sweep, swept_index = (
            coarse.sample(values[:, None], net.grid.directions)[:, 0]
            for values in ((swept.confidence > SURE).float(), swept.index)
        )
        corrected = (sure_sweep > 0.99) & (said.confidence < UNSURE)
        index = swept_index.where(corrected, said.index)
        return Taught(
            name,
            images,
            inverse_depth_from_index(index, *self.hypotheses)[0],
            (corrected | (said.confidence >= UNSURE))[0],
            (correlation[0] * 255).round().byte(),
            known[0],
            share,
        )


class _Frames(Dataset[Sample]):
    """Frames on the icosphere, as they are or, once ``disturbed`` is set, disturbed."""

    def __init__(self, frames: list[Taught], rig: CameraRig, level: int) -> None:
        self.frames, self.rig = frames, rig
        self.to_sphere = ToSphere(level, 2, antialias=True)
        #: How often a disturbed frame is grey; None for frames as they are.
        self.disturbed: float | None = None
        self.preparation = AS_IT_IS

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Sample:
        frame = self.frames[index]
        images, rig = _floats(frame.images), self.rig
        more = {"correlation": frame.correlation, "known": frame.known}
        if self.disturbed is not None:
            faulty = random_disturbance(max(self.disturbed, 0.2))({"images": images, "rig": rig})
            images, rig, more = faulty["images"], faulty["rig"], {}
            images = self.preparation.images(rig, images)
        return {
            "images": self.to_sphere.images(images, rig),
            "seen": self.to_sphere.seen(rig),
            "rig": rig,
            "inverse_depth": frame.inverse_depth,
            "valid": frame.valid,
            "frame": frame.name,
            **more,
        }


class _Mixed(Dataset[Sample]):
    """Frames, in whose place a share of the time a rendered scene stands."""

    def __init__(self, frames: _Frames, scenes: Rehearsal, share: float, scale: float) -> None:
        self.frames, self.scenes, self.share, self.scale = frames, scenes, share, scale

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Sample:
        if torch.rand(()).item() >= self.share:
            return self.frames[index]
        sample = self.scenes[int(torch.randint(len(self.scenes), ()))]
        return {
            **sample,
            "rig": sample["rig"].scaled(self.scale),
            "inverse_depth": sample["inverse_depth"] / self.scale,
        }


def _kept(images: dict[str, Tensor]) -> dict[str, Tensor]:
    """Images as bytes, averaged down where they are larger than needed."""
    kept = {}
    for name, image in images.items():
        factor = image.shape[-2] / MOST_ROWS
        if factor > 1:
            size = (MOST_ROWS, round(image.shape[-1] / factor))
            image = F.interpolate(image[None], size, mode="area")[0]
        kept[name] = (image * 255).round().byte()
    return kept


def _floats(images: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: image.float() / 255 for name, image in images.items()}


def _is_grey(images: dict[str, Tensor]) -> bool:
    spread = [(image.amax(0) - image.amin(0)).float().mean() / 255 for image in images.values()]
    return max(spread).item() < COLORLESS


def _smaller(rig: CameraRig) -> CameraRig:
    """The rig with images of no more rows than rendered scenes need."""
    sizes = {}
    for name, camera in rig.cameras.items():
        height, width = camera.image_size
        factor = max(1.0, height / RENDERED_ROWS)
        sizes[name] = (math.floor(height / factor), round(width / factor))
    return rig.resized(sizes)
