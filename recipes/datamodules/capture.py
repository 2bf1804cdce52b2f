# SPDX-License-Identifier: Apache-2.0
"""A capture without truth as training data: a trained network and a sweep give the depth that is learned."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from annotated_types import Ge
from torch import Tensor
from torch.utils.data import Dataset

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.predictor import check_number
from sphericalvision.capture.preparation.nearest import nearest_hypothesis
from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.capture.pseudo_labels import PseudoLabeller, PseudoLabels
from sphericalvision.capture.sources.frames import spread_evenly
from sphericalvision.core import ArgumentError
from sphericalvision.data import SampleView
from sphericalvision.data.sample_view import ToView
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.app.captures import (
    AUTO,
    CaptureFields,
    cut_to_visible,
    recorded_names,
    recorded_photographs,
    with_own_body_masked,
)
from sphericalvision.recipes.app.cli import track
from sphericalvision.recipes.app.kinds import Count, Fraction, Number, Positive
from sphericalvision.recipes.datamodules.data_module import PreparedSamples, Sample
from sphericalvision.scenes import World, WorldSamples
from sphericalvision.scenes.cache import decode, encode
from sphericalvision.scenes.disturbances import RandomFaults
from sphericalvision.scenes.world import HELD_OUT_SEED, NATURAL_MIN_DEPTH

MAX_ROWS, RENDERED_ROWS = 512, 256
"""Rows of images that are kept, finer than an icosphere of level 6; and of those that are rendered."""
NUM_RENDERED = 100_000
"""Scenes that training draws from."""
COLORLESS = 0.01
"""Mean difference of colour channels, of the range [0, 1], below which a capture counts as grey."""


class LabelledFrame(NamedTuple):
    """A frame, its images as uint8 ``(3, h, w)`` by camera name, and its pseudo-labels."""

    name: str
    images: dict[str, Tensor]
    labels: PseudoLabels


def rehearsed_world(
    rig: CameraRig, grey: float, preparation: Preparation, values: Mapping[str, Any]
) -> World:
    """Scenes of all kinds as a rig would see them.

    Args:
        rig: in metres in which 0.55 is the nearest hypothesis, its images not larger than needed.
        grey: fraction of samples without colour.
        preparation: of the disturbed images, as they are made ready in use.
        values: arguments of ``World``, as in ``conf/world/rehearsal.yaml``.
    """
    chosen = {name: value for name, value in values.items() if name != "level_rigs"}
    chosen["faults"] = {**values["faults"], "grey": grey}
    return World.of(chosen, rig=rig, prepare=preparation.of_images)


@dataclass(eq=False, repr=False, kw_only=True)
class CaptureDataModule(CaptureFields, PreparedSamples):
    """Frames of a capture, some to learn from and some to judge by, and rendered scenes seen through its rig.

    What is to be learned of a frame is what the network, as it is at first, says of the undisturbed images where it
    is sure, and the semi-global sweep where that is sure and the network is not. Training shows it the same images
    disturbed: vignetting, exposure, noise, blur, poses a little off. A share of the samples are rendered scenes with
    their truth, through the same rig and the same disturbances, so that what was learned before is kept and suits this
    rig.

    Lengths are scaled so that the nearest hypothesis is that of the network: scaling a rig and everything around it
    changes no image. Frames are read once and kept, at most 512 rows of each image. What makes images ready is done to
    the disturbed ones, too, so that what is left of the disturbances is learned.

    The capture has the keys of ``CaptureFields``.
    """

    world: dict[str, Any]
    frames: list[int | str] | None = None
    start: Number = 0
    stop: Count | None = None
    every: Count = 1
    num_frames: Annotated[int, Ge(2)] = 50
    held_out_every: Annotated[int, Ge(2)] = 5
    min_depth: Positive | Literal["auto", "scene"] = "auto"
    trained_radius: Positive = 0.2
    rendered: Fraction = 0.5
    rendered_seed: Number = 5_000_000

    has_truth = False

    def __post_init__(self) -> None:
        if self.rendered_seed + NUM_RENDERED > HELD_OUT_SEED:
            raise ArgumentError(
                f"data.rendered_seed: seeds from {HELD_OUT_SEED} are held out for the benchmark, and {NUM_RENDERED} "
                f"scenes follow this one; set {HELD_OUT_SEED - NUM_RENDERED} or less, got {self.rendered_seed}"
            )
        self.preparation = Preparation(self.photometric)
        self.capture = self.capture_with(
            frames=self.frames, start=self.start, stop=self.stop, every=self.every
        )
        self.source = self.capture.open()
        names = recorded_names(self.source, self.capture.selection, "data.")
        if len(names) < 2:
            raise ArgumentError(
                f"data.images: expected two or more frames, some to learn from and some to judge by, got {len(names)}"
            )
        self.names = spread_evenly(names, self.num_frames)
        cut_to_visible(self.source, self.max_angle_deg)
        self.labelled: dict[str, LabelledFrame] = {}
        self.rig = self.source.rig
        self.net: DepthNetwork | None = None

    @property
    def held_out(self) -> list[str]:
        """Names of the frames that judge."""
        offset = min(self.held_out_every // 2, len(self.names) - 1)
        return self.names[offset :: self.held_out_every]

    def bind_network(self, net: Any, *more: str, depth_level: int | None = None) -> None:
        """Give samples on the network's icospheres.

        Raises:
            ArgumentError: the network is not one on icospheres, or for another number of cameras.
        """
        if net.images != "sphere" or net.depth_level is None:
            raise ArgumentError(f"data: captures are for networks on icospheres, not {type(net).__name__}")
        check_number(net, self.rig)
        self.net = net

    def setup(self, stage: str) -> None:
        """Read the frames and let network and sweep say what they think, once."""
        if self.labelled:
            return
        if self.net is None:
            raise ArgumentError(
                "data: a network teaches what is in a capture; call bind_network(net) before setup"
            )
        rig = _with_rows(self.source.rig, MAX_ROWS)
        reading = recorded_photographs(self.source, self.names)
        frames = track(reading, "reading frames", total=len(self.names))
        photographs = {name: _encoded(images, rig) for name, images in frames}
        if self.capture.masks == AUTO:
            rig = with_own_body_masked(rig, map(_floats, photographs.values()))
        self.near = self._nearest(rig, photographs)
        self.rig = rig.scaled(self.net.min_depth / self.near)
        labeller = PseudoLabeller(self.net, self.rig)
        for name in track(self.names, "asking network and sweep"):
            images = _encoded(self.preparation.images(self.rig, _floats(photographs[name])), self.rig)
            self.labelled[name] = LabelledFrame(name, images, labeller(_floats(images)))
        differences = [
            ((image.amax(0) - image.amin(0)).float().mean() / 255).item()
            for images in photographs.values()
            for image in images.values()
        ]
        self.grey = float(max(differences) < COLORLESS)

    def _nearest(self, rig: CameraRig, photographs: dict[str, dict[str, Tensor]]) -> float:
        assert self.net is not None
        self.net.trained_radius = self.trained_radius
        nearest = nearest_hypothesis(self.min_depth, self.net, rig)
        if nearest.metres is not None:
            return nearest.metres
        return nearest.in_frames([_floats(photographs[name]) for name in spread_evenly(self.names, 3)], rig)

    @property
    def start_share(self) -> float:
        """Photo-consistency of the held-out frames by the network as it was at first."""
        fractions = [self.labelled[name].labels.share for name in self.held_out]
        return sum(fractions) / len(fractions)

    def dataset(self, split: str) -> Dataset[Sample]:
        """Disturbed frames and rendered scenes in "train", the held-out frames as they are otherwise."""
        assert self.net is not None
        chosen = [name for name in self.names if (name in self.held_out) == (split != "train")]
        frames = [self.labelled[name] for name in chosen]
        if split != "train":
            return CaptureSamples(frames, self.rig, self.net.level)
        scenes = self._rendered_scenes() if self.rendered else None
        faults = RandomFaults.of(self.world["faults"])
        faults = replace(faults, grey=max(self.grey, faults.grey))
        scale = self.net.min_depth / NATURAL_MIN_DEPTH
        disturbed = Disturbed(faults, self.preparation, scenes, self.rendered, scale)
        return CaptureSamples(frames, self.rig, self.net.level, disturbed)

    def _rendered_scenes(self) -> WorldSamples:
        """Scenes of natural size through the rig.

        Raises:
            ArgumentError: cameras lie where things of the scenes may be.
        """
        assert self.net is not None
        world = rehearsed_world(
            _with_rows(self.rig.scaled(NATURAL_MIN_DEPTH / self.net.min_depth), RENDERED_ROWS),
            self.grey,
            self.preparation,
            self.world,
        )
        view = SampleView(self.net.level, self.net.depth_level, antialias=True)
        seeds = range(self.rendered_seed, self.rendered_seed + NUM_RENDERED)
        try:
            return WorldSamples(world, view, seeds)
        except ArgumentError as error:
            raise ArgumentError(
                f"data.rendered: scenes keep too little space free for this rig, whose nearest hypothesis is at "
                f"{self.near:.2f} m; set data.rendered=0, or a larger data.min_depth. In the units of scenes: {error}"
            ) from error


class Disturbed(NamedTuple):
    """Changes of the frames of a capture in training.

    Attributes:
        faults: of the cameras, others each time.
        preparation: of the disturbed images.
        scenes: that stand in the place of frames, if any.
        fraction: of the samples that are scenes.
        scale: metres of the frames in one of the scenes.
    """

    faults: RandomFaults
    preparation: Preparation
    scenes: WorldSamples | None
    fraction: float
    scale: float


class CaptureSamples(Dataset[Sample]):
    """Frames on the icosphere, as they are, or with faults and preprocessed again, and scenes in their place.

    Args:
        frames: with their pseudo-labels.
        rig: of their images.
        level: of the icosphere that carries images.
        disturbed: how frames are changed; as they are when not given.
    """

    def __init__(
        self, frames: list[LabelledFrame], rig: CameraRig, level: int, disturbed: Disturbed | None = None
    ) -> None:
        self.frames, self.rig, self.disturbed = frames, rig, disturbed
        self.to_view = ToView(SampleView(level, antialias=True))

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Sample:
        name, stored, labels = self.frames[index]
        images, rig = _floats(stored), self.rig
        entries: Sample = {"inverse_depth": labels.inverse_depth, "valid": labels.valid, "frame": name}
        if self.disturbed is None:
            entries |= {"correlation": labels.correlation, "correlation_seen": labels.seen}
        else:
            faults, preparation, scenes, fraction, scale = self.disturbed
            if torch.rand(()).item() < fraction and scenes is not None:
                return self._scene(scenes, scale)
            faulty = faults.draw()({"images": images, "rig": rig})
            rig = faulty["rig"]
            images = preparation.images(rig, faulty["images"])
        return {**entries, **self.to_view.images(images, rig), "rig": rig}

    @staticmethod
    def _scene(scenes: WorldSamples, scale: float) -> Sample:
        """Any of the rendered scenes, its lengths multiplied by ``scale``."""
        sample = scenes[int(torch.randint(len(scenes), ()))]
        return {
            **sample,
            "rig": sample["rig"].scaled(scale),
            "inverse_depth": sample["inverse_depth"] / scale,
        }


def _encoded(images: Mapping[str, Tensor], rig: CameraRig) -> dict[str, Tensor]:
    """Images as bytes, averaged to the sizes of a rig's cameras."""
    return {
        name: encode(F.interpolate(image[None], rig.cameras[name].image_size, mode="area")[0])
        for name, image in images.items()
    }


def _floats(images: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: decode(image) for name, image in images.items()}


def _with_rows(rig: CameraRig, rows: int) -> CameraRig:
    """The rig with images of at most so many rows."""
    sizes = {}
    for name, camera in rig.cameras.items():
        height, width = camera.image_size
        sizes[name] = (min(height, rows), round(width * min(1.0, rows / height)))
    return rig.resized(sizes)
