# SPDX-License-Identifier: Apache-2.0
"""The methods that are compared, each a ``DepthNetwork``: by name, by file, or as an object."""

from __future__ import annotations

import time
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, reference_kernels
from sphericalvision.icosphere import Icosphere
from sphericalvision.io.files import atomic_write
from sphericalvision.models import DepthNetwork, SemiGlobalSweep, WinnerTakesAll
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.study.benchmark.frames import Frame
from sphericalvision.recipes.training.rig_tables import RigTables
from sphericalvision.scenes import make_scene, ray_depth
from sphericalvision.scenes.registry import kind_of
from sphericalvision.scenes.world import HELD_OUT_SEED, NATURAL_MIN_DEPTH
from sphericalvision.sweep import DepthEstimate, index_from_inverse_depth

__all__ = [
    "HYPOTHESES",
    "MIN_DEPTH",
    "ConstantMap",
    "Cost",
    "Method",
    "Said",
    "identity_of",
    "make_method",
    "make_methods",
]

HYPOTHESES, MIN_DEPTH = 16, NATURAL_MIN_DEPTH
"""N that errors are percentages of, and metres of the nearest hypothesis, for all methods alike."""

TRAINING_SCENES = 70
"""Of seeds 0 and up, every kind in turn: what the constant map is the median of."""


class Said(NamedTuple):
    """What a method says of one frame: an estimate on its own grid, and what it took, CPU seconds."""

    estimate: DepthEstimate
    seconds: float


class Cost(NamedTuple):
    """What a method takes: numbers learned, and billions of floating-point operations a frame (None: not counted)."""

    parameters: int
    gflop: float | None


class ConstantMap(DepthNetwork):
    """One depth map for all frames: the median of training scenes at each vertex; it does not look at images.

    Args:
        level: of its icosphere.
        scenes: number of training scenes, of seeds 0 and up, all kinds of scenes in turn.
    """

    index: Tensor

    def __init__(self, level: int = 4, scenes: int = 70) -> None:
        super().__init__(HYPOTHESES, MIN_DEPTH, num_cameras=2, any_cameras=True)
        self.level, self.grid = max(level, 2), Icosphere(level)
        self.register_buffer("index", torch.zeros(self.grid.num_vertices))
        self.scenes = scenes

    def fit(self) -> ConstantMap:
        """Take the median over the training scenes."""
        assert self.scenes < HELD_OUT_SEED
        directions, indices = self.grid.directions, []
        for seed in range(self.scenes):
            scene = make_scene(kind_of("all", seed), seed)
            inverse_depth = ray_depth(scene, torch.zeros(3), directions).reciprocal()
            indices.append(index_from_inverse_depth(inverse_depth, HYPOTHESES, MIN_DEPTH))
        self.index = torch.stack(indices).median(0).values
        return self

    def predict(self, images: Tensor, rig: CameraRig | Any, seen: Tensor | None = None) -> DepthEstimate:
        """The same for each image."""
        index = self.index.expand(len(images), -1)
        return DepthEstimate(index, torch.ones_like(index), torch.ones_like(index, dtype=torch.bool))


class Method:
    """A network in the comparison.

    Args:
        name: of its column and its files.
        net: any ``DepthNetwork``; its own level of images and hypotheses are kept, its ``min_depth`` must be that of
            the benchmark.
    """

    def __init__(self, name: str, net: DepthNetwork) -> None:
        self.name, self.net = name, net.eval()
        self._tables = RigTables(net, capacity=4)

    @property
    def identity(self) -> str:
        """Characters that change whenever its answers may: class, hyper-parameters, weights."""
        return identity_of(self.net)

    @torch.no_grad()
    def __call__(self, frame: Frame) -> Said:
        """Estimate a frame; what follows from the rig alone is not counted in the time."""
        images, seen = self.inputs(frame)
        tables = self._tables.of(frame.rig)
        began = time.process_time()
        estimate = self.net.predict(images, tables, seen)
        return Said(estimate, time.process_time() - began)

    def inputs(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """Images and what was seen, as the network wants them, a batch of one."""
        intake = self.net.intake(frame.rig)
        return intake(frame.images)[None], intake.seen[None]

    @torch.no_grad()
    def cost(self, frame: Frame) -> Cost:
        """Parameters, and operations by torch's counter over the reference kernels: matrices and convolutions."""
        from torch.utils.flop_counter import FlopCounterMode

        images, seen = self.inputs(frame)
        tables = self._tables.of(frame.rig)
        counter = FlopCounterMode(display=False)
        with reference_kernels(), counter:
            self.net.predict(images, tables, seen)
        number = sum(parameter.numel() for parameter in self.net.parameters())
        return Cost(number, counter.get_total_flops() / 1e9 if number else None)


def make_method(word: str, level: int = 6, constant: Path | None = None) -> Method:
    """The method that a word stands for.

    Args:
        word: "constant", "winner-takes-all", "semi-global-sweep", the name of weights that ship, or a file of weights.
        level: of the images, for methods without training.
        constant: file in which the constant map is kept.

    Raises:
        ArgumentError: a network for another number of cameras.
        MissingFileError: neither a name nor a file.
    """
    net: DepthNetwork
    if word == "constant":
        net = _constant_map(max(level - 2, 0), constant)
    elif word == "winner-takes-all":
        net = WinnerTakesAll(level, HYPOTHESES, MIN_DEPTH)
    elif word == "semi-global-sweep":
        net = SemiGlobalSweep(level, HYPOTHESES, MIN_DEPTH)
    else:
        net = load_network(word, min_depth=MIN_DEPTH)
    return Method(method_name(word), net)


def _kept(path: Path) -> dict[str, Any] | None:
    """What a file holds; None if it is not there, or is damaged and has to be made anew."""
    try:
        content: dict[str, Any] = torch.load(path, weights_only=True)
        return content if {"level", "scenes", "index"} <= set(content) else None
    except Exception:  # whatever a damaged file makes of itself
        return None


def _constant_map(level: int, path: Path | None) -> ConstantMap:
    net = ConstantMap(level, TRAINING_SCENES)
    kept = None if path is None else _kept(path)
    if kept is not None and kept["level"] == level and kept["scenes"] == net.scenes:
        net.index = kept["index"]
        return net
    net.fit()
    if path is not None:
        with atomic_write(path) as temporary:
            torch.save({"level": level, "scenes": net.scenes, "index": net.index}, temporary)
    return net


def method_name(word: str) -> str:
    """The name of a method's column: its word, or the stem of its file."""
    return Path(word).stem if Path(word).suffix else word


def make_methods(words: Sequence[str], level: int, constant: Path | None = None) -> list[Method]:
    """The methods that words stand for, each as ``make_method`` makes it.

    Raises:
        ArgumentError: none, or two of one name.
    """
    names = [method_name(word) for word in words]
    for name in names:
        if names.count(name) > 1:
            raise ArgumentError(f"benchmark.methods: {name} is given twice; rename one of the files")
    if not names:
        raise ArgumentError("benchmark.methods: expected at least one, got none")
    return [make_method(word, level, constant) for word in words]


def identity_of(net: DepthNetwork) -> str:
    """Characters that change with a network's class, hyper-parameters and weights."""
    digest = sha256(repr((type(net).__name__, net.hyperparameters)).encode())
    for key, tensor in net.state_dict().items():
        digest.update(key.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]
