# SPDX-License-Identifier: Apache-2.0
"""A method is a depth network, its estimates looked up in any direction and any hypotheses; baselines among them."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Subset

from sphericalvision import __version__
from sphericalvision.cameras import CameraRig
from sphericalvision.capture import Predictor, align_rig
from sphericalvision.capture.preparation.preparation import AS_IT_IS, Preparation
from sphericalvision.core import ArgumentError
from sphericalvision.data import SampleView
from sphericalvision.kernels import reference_kernels
from sphericalvision.models import (
    ConstantDepth,
    DepthNetwork,
    SemiGlobalSweep,
    WinnerTakesAll,
)
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.models.weights.files import identity_of
from sphericalvision.recipes.datamodules.entries import images_of
from sphericalvision.recipes.evaluation.rectified_sgbm import RectifiedSGBM
from sphericalvision.recipes.training.rig_tables import RigTables
from sphericalvision.scenes import make_scene, ray_depth
from sphericalvision.scenes.registry import TURNS, kind_of
from sphericalvision.scenes.world import HELD_OUT_SEED, NATURAL_MIN_DEPTH
from sphericalvision.sphere.intake import unsigned
from sphericalvision.sweep import DepthEstimate, index_from_inverse_depth, inverse_depth_from_index

if TYPE_CHECKING:
    from sphericalvision.recipes.datamodules.data_module import SampleDataModule


class Scale(NamedTuple):
    """The hypotheses that errors are percentages of: how many, and the nearest in metres."""

    num_hypotheses: int
    min_depth: float


SCALE = Scale(16, NATURAL_MIN_DEPTH)
"""The hypotheses that errors are percentages of, for all methods alike."""

Batch = Any
"""Some frames: whatever methods find images, and a measure the truth in; mostly samples that are put together."""

UNTRAINED: dict[str, Callable[[int, int, float], DepthNetwork]] = {
    "semi-global-sweep": SemiGlobalSweep,
    "winner-takes-all": WinnerTakesAll,
    "rectified-sgbm": RectifiedSGBM,
}
"""Methods without training."""

TRAINING_SCENES = 70
"""Scenes that the constant map is the median of: seeds 0 and up, every kind in turn."""


class Method:
    """A network in a comparison.

    Args:
        name: of its row or column, and its files.
        net: any ``DepthNetwork``, or what makes one, which is asked when the first frame is estimated; its own level of
            images and hypotheses are kept.
        min_confidence: where the network is less confident, it says nothing.
        identity: what its estimates depend on; a digest of the network if not given.
        label: in tables and pictures; the name if not given.
        seed: of its training, where there are several.
    """

    def __init__(
        self,
        name: str,
        net: DepthNetwork | Callable[[], DepthNetwork],
        min_confidence: float = 0.0,
        identity: Any = None,
        label: str | None = None,
        seed: int | None = None,
    ) -> None:
        self.name, self.min_confidence, self.label, self.seed = name, min_confidence, label or name, seed
        self._net, self._identity = net, identity

    @cached_property
    def net(self) -> DepthNetwork:
        """The network, in evaluation mode."""
        return (self._net if isinstance(self._net, DepthNetwork) else self._net()).eval()

    @cached_property
    def identity(self) -> Any:
        """Digest of all that its estimates depend on; records of another one do not count."""
        return identity_of(self.net) if self._identity is None else self._identity

    @cached_property
    def _tables(self) -> RigTables:
        return RigTables(self.net)

    def forget_rigs(self) -> None:
        """Free what follows from the rigs of the frames so far, before frames of another rig."""
        self.__dict__.pop("_tables", None)

    def _inputs(self, batch: Batch) -> tuple[Tensor, Any, Tensor | None]:
        """Images, tables of their rig, and what of them was seen, of samples put together, or of a frame alone."""
        if isinstance(batch, dict):
            images, seen = images_of(batch, self.net)
            return images, self._tables.of(batch["rig"]), seen
        intake = self.net.intake(batch.rig)
        return intake(batch.images)[None], self._tables.of(batch.rig), intake.seen[None]

    @torch.no_grad()
    def __call__(self, batch: Batch) -> Answer:
        """Estimate a batch; what follows from the rig alone is not counted in the time."""
        inputs = self._inputs(batch)
        began = time.process_time()
        estimate = self.net.predict(*inputs)
        return Answer(self.net, estimate, self.min_confidence, time.process_time() - began)

    @torch.no_grad()
    def cost(self, batch: Batch) -> dict[str, float | None]:
        """Parameters, and ``gflop`` by torch's counter over the reference kernels: matrices and convolutions.

        Operations are None for a method without parameters, whose work is of other kinds.
        """
        from torch.utils.flop_counter import FlopCounterMode

        inputs, counter = self._inputs(batch), FlopCounterMode(display=False)
        with reference_kernels(), counter:
            self.net.predict(*inputs)
        count = sum(parameter.numel() for parameter in self.net.parameters())
        return {"parameters": count, "gflop": counter.get_total_flops() / 1e9 if count else None}


class AsUsed(Method):
    """A ``Method`` by way of a ``Predictor``: from the images of the cameras, as in use.

    Args:
        net: errors are in its hypotheses, whichever the predictor takes.
        min_depth: nearest hypothesis in metres; ``"auto"`` and ``"scene"`` as of ``Predictor``, of each frame.
        masked: gives a rig masks, before it is used.
    """

    def __init__(
        self,
        name: str,
        net: DepthNetwork,
        min_confidence: float = 0.0,
        min_depth: float | Literal["auto", "scene"] = "auto",
        preparation: Preparation = AS_IT_IS,
        masked: Callable[[CameraRig], CameraRig] = lambda rig: rig,
    ) -> None:
        super().__init__(name, net, min_confidence)
        self.masked = masked
        self.options: dict[str, Any] = {"min_depth": min_depth, "preparation": preparation}

    @torch.no_grad()
    def __call__(self, batch: Batch) -> Answer:
        """Estimate each frame of samples with the entry "fisheye"."""
        frames = [self._estimate(*frame) for frame in camera_images(batch)]
        estimate = DepthEstimate(*(torch.stack(values) for values in zip(*frames, strict=True)))
        return Answer(self.net, estimate, self.min_confidence)

    def _estimate(self, rig: CameraRig, images: dict[str, Tensor]) -> DepthEstimate:
        predictor = Predictor(self.masked(rig), self.net, **self.options)
        if self.options["preparation"].align:
            predictor = predictor.with_changes(align_rig(predictor, [images]).rig)
        depth = predictor(images)
        nearer = self.net.min_depth / depth.min_depth  # the same inverse depth has another index
        index = (depth.index * nearer).clamp(max=self.net.num_hypotheses - 1)
        return DepthEstimate(index, depth.confidence, depth.seen)


class Answer:
    """Estimates of a method for a batch.

    Args:
        net: whose estimate it is.
        estimate: on the grid of the network, ``(B, *grid)``.
        min_confidence: where the network is less confident, nothing is known.
        seconds: of CPU that it took.
    """

    def __init__(
        self, net: DepthNetwork, estimate: DepthEstimate, min_confidence: float = 0.0, seconds: float = 0.0
    ) -> None:
        self.net, self.estimate, self.min_confidence, self.seconds = net, estimate, min_confidence, seconds

    def index_at(self, directions: Tensor, scale: Scale) -> tuple[Tensor, Tensor]:
        """Index in the hypotheses of a scale in directions ``(V, 3)``, and where the method says one, both ``(B, V)``.

        Between the points of the network's grid it is linear. Where that does not reach, it is that of the nearest
        point, and not known.
        """
        index, valid = self._look_up(self.estimate.index, directions)
        if scale == (self.net.num_hypotheses, self.net.min_depth):
            index = index.clamp(min=0)  # where it is interpolated infinity may be a rounding beyond
        else:
            inverse_depth = inverse_depth_from_index(index, self.net.num_hypotheses, self.net.min_depth)
            index = index_from_inverse_depth(inverse_depth, *scale)
        valid = valid.expand(index.shape)
        if self.min_confidence > 0:
            valid = valid & (self.confidence_at(directions) >= self.min_confidence)
        return index, valid

    def confidence_at(self, directions: Tensor) -> Tensor:
        """Confidence ``(B, V)``."""
        return self._look_up(self.estimate.confidence, directions)[0]

    def _look_up(self, values: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        points = self.net.grid.directions
        if points.shape == directions.shape and torch.equal(points.to(directions), directions):
            return values.float(), torch.ones(len(directions), dtype=torch.bool, device=values.device)
        return self.net.index_at(values.float(), directions)


def camera_images(batch: dict[str, Any]) -> list[tuple[CameraRig, dict[str, Tensor]]]:
    """The rig and the images by camera of each frame of a batch, in [0, 1], black where lenses show nothing."""
    light = unsigned(batch["fisheye"]).clamp(0, 1) * batch["fisheye_seen"].unsqueeze(2)
    rigs = [batch["rig"].select(frame) for frame in range(len(light))]
    return [(rig, dict(zip(rig.names, images, strict=True))) for rig, images in zip(rigs, light, strict=True)]


def baselines(scale: Scale, level: int, depths: Iterable[Mapping[str, Tensor]]) -> list[Method]:
    """The methods that need no images, and the sweeps, for images of a level: what every network is compared with.

    Args:
        scale: their hypotheses.
        level: of the images.
        depths: batches with ``inverse_depth`` and ``valid`` of frames of which the best depth map and the best single
            depth, by the mean absolute error, are the medians.

    Raises:
        ArgumentError: no depth is valid.
    """
    pairs = [(batch["inverse_depth"], batch["valid"]) for batch in depths]
    inverse_depth, valid = map(torch.cat, zip(*pairs, strict=True))
    if not valid.any():
        raise ArgumentError("data: no training sample has a valid depth to take the median of; check data.*")
    shapes = {"constant depth map": inverse_depth.shape, "constant depth": (-1, 1)}
    medians = {
        name: ConstantDepth(level, *scale).fit(inverse_depth.reshape(shape), valid.reshape(shape))
        for name, shape in shapes.items()
    }
    sweeps = {word: UNTRAINED[word](level, *scale) for word in ("winner-takes-all", "semi-global-sweep")}
    return [Method(name, net) for name, net in (medians | sweeps).items()]


def training_depths(data: SampleDataModule, level: int, max_frames: int | None = None) -> DataLoader[Any]:
    """Batches with the depth of training frames, two levels below ``level``; at most some frames, evenly chosen."""
    if hasattr(data, "view"):  # without images nothing is rendered
        data = copy.copy(data)
        data.view = SampleView(depth_level=level - 2)
    frames = data.plain_train_dataset()
    count = len(frames)  # type: ignore[arg-type]
    return data.loader(Subset(frames, range(0, count, -(-count // max_frames) if max_frames else 1)))


def check_names(methods: Sequence[Method]) -> None:
    """Refuse two methods of one name."""
    names = [method.name for method in methods]
    for name in names:
        if names.count(name) > 1:
            raise ArgumentError(f"methods: {name} is given twice; rename one of the files")


def make_method(word: str, level: int = 6, scale: Scale = SCALE) -> Method:
    """The method that a word names.

    Args:
        word: "constant", "winner-takes-all", "semi-global-sweep", "rectified-sgbm", the name of weights that ship, or a
            file of weights.
        level: of the images, for methods without training.
        scale: their hypotheses; a network has its own number of them from the same nearest depth.

    Raises:
        MissingFileError: neither a name nor a file.
    """
    if word == "constant":
        # It takes a quarter of a minute, so it is made when the first frame is estimated, and known without that.
        identity = [word, __version__, TRAINING_SCENES, level, *scale]
        return Method(word, partial(_scene_median, level, scale), identity=identity)
    if word in UNTRAINED:
        return Method(word, UNTRAINED[word](level, *scale))
    net = read_network(word).with_changes(min_depth=scale.min_depth)
    return Method(Path(word).stem if Path(word).suffix else word, net)


def _scene_median(level: int, scale: Scale) -> DepthNetwork:
    """The median of the training scenes."""
    assert TRAINING_SCENES < HELD_OUT_SEED
    directions = ConstantDepth(level, *scale).grid.directions
    scenes = [make_scene(kind_of(TURNS, seed), seed) for seed in range(TRAINING_SCENES)]
    inverse = torch.stack([ray_depth(scene, torch.zeros(3), directions).reciprocal() for scene in scenes])
    everywhere = torch.ones_like(inverse, dtype=torch.bool)
    return baselines(scale, level, [{"inverse_depth": inverse, "valid": everywhere}])[0].net
