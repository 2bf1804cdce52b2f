# SPDX-License-Identifier: Apache-2.0
"""The methods that are compared, by name or by file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from sphericalvision.core import ArgumentError, SphericalVisionError
from sphericalvision.models import (
    ConstantDepth,
    DepthNetwork,
    SemiGlobalSweep,
    WinnerTakesAll,
    load_weights,
    save_weights,
)
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.evaluation.methods import Inputs, Method, Scale
from sphericalvision.recipes.evaluation.track_frames import TrackFrame
from sphericalvision.scenes import make_scene, ray_depth
from sphericalvision.scenes.registry import kind_of
from sphericalvision.scenes.world import HELD_OUT_SEED, NATURAL_MIN_DEPTH

__all__ = ["SCALE", "frame_inputs", "make_method", "make_methods"]

SCALE = Scale(16, NATURAL_MIN_DEPTH)
"""The hypotheses that errors are percentages of, for all methods alike."""

TRAINING_SCENES = 70
"""Of seeds 0 and up, every kind in turn: what the constant map is the median of."""


def frame_inputs(frame: TrackFrame, net: DepthNetwork) -> Inputs:
    """Images and what was seen, as a network wants them, a batch of one."""
    intake = net.intake(frame.rig)
    return Inputs(intake(frame.images)[None], intake.seen[None], frame.rig)


def make_methods(words: Sequence[str], level: int, folder: Path | None = None) -> list[Method]:
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
    return [make_method(word, level, folder) for word in words]


def make_method(word: str, level: int = 6, folder: Path | None = None) -> Method:
    """The method that a word stands for.

    Args:
        word: "constant", "winner-takes-all", "semi-global-sweep", the name of weights that ship, or a file of weights.
        level: of the images, for methods without training.
        folder: in which the constant map is kept.

    Raises:
        MissingFileError: neither a name nor a file.
    """
    net: DepthNetwork
    if word == "constant":
        net = _constant(level, folder)
    elif word in ("winner-takes-all", "semi-global-sweep"):
        net = (WinnerTakesAll if word == "winner-takes-all" else SemiGlobalSweep)(level, *SCALE)
    else:
        net = load_network(word, min_depth=SCALE.min_depth)
    return Method(method_name(word), net, inputs=frame_inputs)


def method_name(word: str) -> str:
    """The name of a method's column: its word, or the stem of its file."""
    return Path(word).stem if Path(word).suffix else word


def _constant(level: int, folder: Path | None) -> DepthNetwork:
    """The median of the training scenes, which is kept: it takes a quarter of a minute."""
    path = None if folder is None else folder / f"constant-{level}-{TRAINING_SCENES}.safetensors"
    if path is not None and path.is_file():
        try:
            return load_weights(path)
        except SphericalVisionError:
            pass  # damaged, so it is made anew
    assert TRAINING_SCENES < HELD_OUT_SEED
    net = ConstantDepth(level, *SCALE)
    scenes = [make_scene(kind_of("all", seed), seed) for seed in range(TRAINING_SCENES)]
    directions = net.grid.directions
    net.fit(torch.stack([ray_depth(scene, torch.zeros(3), directions).reciprocal() for scene in scenes]))
    if path is not None:
        save_weights(net, path)
    return net
