# SPDX-License-Identifier: Apache-2.0
"""A method is a depth network, its estimates looked up in any direction and any hypotheses; baselines among them."""

from __future__ import annotations

import time
from collections.abc import Callable
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from rich.progress import track
from torch import Tensor
from torch.utils.data import DataLoader

from sphericalvision.cameras import CameraRig
from sphericalvision.capture import Predictor, align_rig
from sphericalvision.capture.preparation.preparation import AS_IT_IS, Preparation
from sphericalvision.core import ArgumentError, reference_kernels
from sphericalvision.models import ConstantDepth, DepthNetwork, SemiGlobalSweep, WinnerTakesAll
from sphericalvision.recipes.datamodules.entries import images_of
from sphericalvision.recipes.evaluation.frames import Batch
from sphericalvision.recipes.training.rig_tables import RigTables
from sphericalvision.sphere.intake import unsigned
from sphericalvision.sweep import DepthEstimate, index_from_inverse_depth, inverse_depth_from_index

if TYPE_CHECKING:
    from sphericalvision.recipes.datamodules.base import SampleDataModule

__all__ = [
    "Answer",
    "AsUsed",
    "Inputs",
    "Method",
    "Scale",
    "baselines",
    "constants",
    "identity_of",
    "photographs_of",
    "sweep",
]


class Scale(NamedTuple):
    """The hypotheses that errors are percentages of: how many, and the nearest in metres."""

    num_hypotheses: int
    min_depth: float


class Inputs(NamedTuple):
    """What a network is given of a batch: images, what of them was seen (None: all in view), and the rig."""

    images: Tensor
    seen: Tensor | None
    rig: CameraRig


def sample_inputs(batch: dict[str, Any], net: DepthNetwork) -> Inputs:
    """The inputs of samples that are put together."""
    images, seen = images_of(batch, net)
    return Inputs(images, seen, batch["rig"])


class Method:
    """A network in a comparison.

    Args:
        name: of its row or column, and its files.
        net: any ``DepthNetwork``; its own level of images and hypotheses are kept.
        min_confidence: where the network is less confident, it says nothing.
        inputs: what a network is given of a batch.
    """

    def __init__(
        self,
        name: str,
        net: DepthNetwork,
        min_confidence: float = 0.0,
        inputs: Callable[[Batch, DepthNetwork], Inputs] = sample_inputs,
    ) -> None:
        self.name, self.net, self.min_confidence, self.inputs = name, net.eval(), min_confidence, inputs
        self._tables = RigTables(net)

    @torch.no_grad()
    def __call__(self, batch: Batch) -> Answer:
        """Estimate a batch; what follows from the rig alone is not counted in the time."""
        images, seen, rig = self.inputs(batch, self.net)
        tables = self._tables.of(rig)
        began = time.process_time()
        estimate = self.net.predict(images, tables, seen)
        return Answer(self.net, estimate, self.min_confidence, time.process_time() - began)

    @torch.no_grad()
    def cost(self, batch: Batch) -> dict[str, float | None]:
        """Parameters, and ``gflop`` by torch's counter over the reference kernels: matrices and convolutions.

        Operations are None for a method without parameters, whose work is of other kinds.
        """
        from torch.utils.flop_counter import FlopCounterMode

        images, seen, rig = self.inputs(batch, self.net)
        tables = self._tables.of(rig)
        counter = FlopCounterMode(display=False)
        with reference_kernels(), counter:
            self.net.predict(images, tables, seen)
        number = sum(parameter.numel() for parameter in self.net.parameters())
        return {"parameters": number, "gflop": counter.get_total_flops() / 1e9 if number else None}


class AsUsed(Method):
    """The same by way of a ``Predictor``: from the images of the cameras, as in use.

    Args:
        name: as of ``Method``.
        net: errors are in its hypotheses, whichever the predictor takes.
        min_confidence: as of ``Method``.
        min_depth: nearest hypothesis in metres; ``"auto"`` and ``"scene"`` as of ``Predictor``, of each frame.
        preparation: of each frame.
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
        frames = [self._estimate(*frame) for frame in photographs_of(batch)]
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
    """What a method says of a batch.

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
        index, known = self._look_up(self.estimate.index, directions)
        if scale == (self.net.num_hypotheses, self.net.min_depth):
            index = index.clamp(min=0)  # where it is interpolated infinity may be a rounding beyond
        else:
            inverse_depth = inverse_depth_from_index(index, self.net.num_hypotheses, self.net.min_depth)
            index = index_from_inverse_depth(inverse_depth, *scale)
        known = known.expand(index.shape)
        if self.min_confidence > 0:
            known = known & (self.confidence_at(directions) >= self.min_confidence)
        return index, known

    def confidence_at(self, directions: Tensor) -> Tensor:
        """Confidence ``(B, V)``."""
        return self._look_up(self.estimate.confidence, directions)[0]

    def _look_up(self, values: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        own = self.net.grid.directions
        if own.shape == directions.shape and torch.equal(own.to(directions), directions):
            return values.float(), torch.ones(len(directions), dtype=torch.bool, device=values.device)
        return self.net.index_at(values.float(), directions)


def photographs_of(batch: dict[str, Any]) -> list[tuple[CameraRig, dict[str, Tensor]]]:
    """The rig and the images by camera of each frame of a batch, in [0, 1], black where lenses show nothing."""
    light = unsigned(batch["fisheye"]).clamp(0, 1) * batch["fisheye_seen"].unsqueeze(2)
    rigs = [batch["rig"].select(frame) for frame in range(len(light))]
    return [(rig, dict(zip(rig.names, images, strict=True))) for rig, images in zip(rigs, light, strict=True)]


def identity_of(net: DepthNetwork) -> str:
    """Characters that change with a network's class, hyper-parameters and weights."""
    digest = sha256(repr((type(net).__name__, net.hyperparameters)).encode())
    for key, tensor in net.state_dict().items():
        digest.update(key.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def baselines(net: DepthNetwork, level: int, data: SampleDataModule) -> list[Method]:
    """The methods that a network is compared with, on images of a level; constants are those of the training set."""
    data.render("train")
    return [
        *constants(net, level, data.loader(data.plain_train_dataset())),
        sweep("photo-consistency sweep", WinnerTakesAll, net, level),
        sweep("semi-global sweep", SemiGlobalSweep, net, level),
    ]


def sweep(
    name: str, kind: type[WinnerTakesAll] | type[SemiGlobalSweep], net: DepthNetwork, level: int
) -> Method:
    """A sweep with the hypotheses of a network, on images of a level."""
    return Method(name, kind(level, net.num_hypotheses, net.min_depth).to(net.device))


def constants(net: DepthNetwork, level: int, loader: DataLoader[dict[str, Any]]) -> list[Method]:
    """The best depth map and the best single depth of frames for the mean absolute error, with a network's hypotheses.

    Raises:
        ArgumentError: no frame has a valid depth.
    """
    batches = [(b["inverse_depth"], b["valid"]) for b in track(loader, "training depths", total=len(loader))]
    if not any(valid.any() for _, valid in batches):
        raise ArgumentError(
            "baselines: the training set has no valid depth to take the median of; check data.*"
        )
    inverse_depth, valid = map(torch.cat, zip(*batches, strict=True))
    shapes = {"constant depth map": inverse_depth.shape, "constant depth": (-1, 1)}
    fresh = {name: ConstantDepth(level, net.num_hypotheses, net.min_depth) for name in shapes}
    return [
        Method(name, fresh[name].fit(inverse_depth.reshape(shape), valid.reshape(shape)).to(net.device))
        for name, shape in shapes.items()
    ]
