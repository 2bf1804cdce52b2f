# SPDX-License-Identifier: Apache-2.0
"""Networks from files: weights, Lightning checkpoints, the authors' format, or what ships in the package."""

from __future__ import annotations

import pickle
from inspect import signature
from pathlib import Path
from typing import Any

import torch

from sphericalvision.core import ArgumentError, FileFormatError, check_file
from sphericalvision.models import IcoSweepNet, OmniMVS
from sphericalvision.models.weights import (
    available_weights,
    load_reference_checkpoint,
    load_weights,
    pretrained,
)

__all__ = ["initialize", "load_network"]

REFERENCE_SUFFIXES = (".pth", ".pt", ".tar")
"""Of checkpoints in the authors' format."""

SHAPED_BY = (
    "aggregation",
    "num_cameras",
    "feature_channels",
    "volume_channels",
    "feature_coarsening",
    "in_channels",
    "num_scales",
    "norm",
)
"""Hyper-parameters that give parameters their shapes; the others may change after training."""

ARCHITECTURES = {"IcoSweepNet": IcoSweepNet, "OmniMVS": OmniMVS}
"""Networks by the name that checkpoints hold."""


def load_network(
    checkpoint: str | Path | None = None,
    level: int | None = None,
    min_depth: float | None = None,
    native: bool = False,
) -> IcoSweepNet | OmniMVS:
    """Load a network of either kind in evaluation mode.

    Its parameters depend neither on ``level`` nor on ``min_depth``, so both may be replaced.

    Args:
        checkpoint: ``.safetensors``, a Lightning ``.ckpt``, or ``.pth`` in the authors' format, or the
            name of a network that ships with the package; its default one when not given.
        level: of the images on the icosphere, instead of the level trained at; only ``IcoSweepNet`` has one.
        min_depth: nearest hypothesis in metres, instead of the one trained with.
        native: whether to use operators in C++; only ``IcoSweepNet`` has some.

    Raises:
        ArgumentError: a level or ``native`` for a network on panoramas.
        MissingCompilerError: the operators could not be compiled.
        MissingFileError: no such file.
        FileFormatError: the file holds no network of this package.
    """
    net = _read(checkpoint).with_changes(level=level, min_depth=min_depth)
    return net.configure(native=native).eval()


def initialize(net: IcoSweepNet | OmniMVS, weights: str | Path) -> None:
    """Start ``net`` from the parameters of another checkpoint, trained at any level.

    Raises:
        ArgumentError: the other network is of another kind, number of cameras or channels; the message names both.
    """
    other = load_network(weights)
    if type(other) is not type(net):
        raise ArgumentError(
            f"init_weights: {weights} is {type(other).__name__}, the network to train {type(net).__name__}"
        )
    mine, theirs = net.hyperparameters, other.hyperparameters
    for key in (key for key in SHAPED_BY if key in mine):
        if mine[key] != theirs[key]:
            raise ArgumentError(
                f"init_weights: {weights} has {key} = {theirs[key]}, the network to train has {mine[key]}; "
                f"set model.{key}={theirs[key]} or take other weights"
            )
    net.load_state_dict(other.state_dict())


def _read(checkpoint: str | Path | None) -> Any:
    if checkpoint is None:
        return pretrained()
    if str(checkpoint) in available_weights() and not Path(checkpoint).exists():
        return pretrained(str(checkpoint))
    path = check_file(checkpoint, "a checkpoint (.safetensors, .ckpt, or the authors' format)")
    if path.suffix == ".safetensors":
        return load_weights(path)
    if path.suffix in REFERENCE_SUFFIXES:
        return load_reference_checkpoint(path)
    if path.suffix != ".ckpt":
        known = ", ".join((".safetensors", ".ckpt", *REFERENCE_SUFFIXES))
        raise ArgumentError(f"checkpoint: {path} has none of the suffixes of checkpoints, {known}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        hyperparameters, state = content["hyper_parameters"], content["state_dict"]
        architecture = ARCHITECTURES[content.get("architecture", "IcoSweepNet")]
        names = signature(architecture).parameters.keys() & hyperparameters.keys()
        net = architecture(**{name: hyperparameters[name] for name in names})
        net.load_state_dict({key[4:]: value for key, value in state.items() if key.startswith("net.")})
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError) as error:
        raise FileFormatError(
            f"{path}: is not a checkpoint of sphericalvision-train, or is damaged "
            f"({str(error).splitlines()[0]:.200}). Give a .ckpt or .safetensors file from the checkpoints "
            "folder of a training run."
        ) from error
    return net
