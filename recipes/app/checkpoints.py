# SPDX-License-Identifier: Apache-2.0
"""Networks from files: weights, Lightning checkpoints, the authors' format, or what ships in the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch

from sphericalvision.core import ArgumentError, FileFormatError, first_line
from sphericalvision.models import DepthNetwork
from sphericalvision.models.weights.checkpoints import read_network

__all__ = ["initialize", "load_network", "read_checkpoint", "refuse_others"]

Found = TypeVar("Found")


def load_network(
    checkpoint: str | Path | None = None,
    level: int | None = None,
    min_depth: float | None = None,
) -> DepthNetwork:
    """Load a network of any kind in evaluation mode.

    Its parameters depend neither on ``level`` nor on ``min_depth``, so both may be replaced.

    Args:
        checkpoint: ``.safetensors``, a Lightning ``.ckpt``, or ``.pth`` in the authors' format, or the
            name of a network that ships with the package; ``refinedsweepnet`` when not given.
        level: of the images on the icosphere, instead of the level trained at, where the network has one.
        min_depth: nearest hypothesis in metres, instead of the one trained with.

    Raises:
        ArgumentError: a level for a network that has no such choice.
        MissingFileError: no such file.
        FileFormatError: the file holds no network of this package.
    """
    return read_network(checkpoint).with_changes(level=level, min_depth=min_depth).eval()


def initialize(net: DepthNetwork, weights: str | Path) -> None:
    """Start ``net`` from the parameters of another checkpoint, trained at any level.

    Raises:
        ArgumentError: the other network is of another kind, number of cameras or channels; the message names both.
    """
    other = load_network(weights)
    if type(other) is not type(net):
        raise ArgumentError(
            f"init_weights: {weights} is {type(other).__name__}, the network to train {type(net).__name__}"
        )
    state, expected = other.state_dict(), net.state_dict()
    if {name: tensor.shape for name, tensor in state.items()} != {n: t.shape for n, t in expected.items()}:
        refuse_others(weights, other.hyperparameters, net.hyperparameters, ("level", "min_depth"))
    net.load_state_dict(state)


def refuse_others(
    weights: str | Path, theirs: Mapping[str, Any], mine: Mapping[str, Any], free: Sequence[str] = ()
) -> None:
    """Refuse weights of other hyper-parameters, but for those that are ``free``.

    Raises:
        ArgumentError: those that differ, of both.
    """
    differ = [key for key in mine if mine[key] != theirs.get(key) and key not in free]
    # None is a network's own choice, which may be the same: it is named where nothing else differs.
    if differ := [key for key in differ if mine[key] is not None] or differ:
        raise ArgumentError(
            f"init_weights: {weights} has "
            + ", ".join(f"{key} = {theirs.get(key)}" for key in differ)
            + f", the network to train has {', '.join(str(mine[key]) for key in differ)}; set "
            + " ".join(f"model.{key}={theirs.get(key)}" for key in differ)
            + " or take other weights"
        )


def read_checkpoint(key: str, path: Path, what: str, take: Callable[[dict[str, Any]], Found]) -> Found:
    """What ``take`` finds in a checkpoint of Lightning's.

    Args:
        key: that names the file.
        path: of the file.
        what: it should be, for the error.
        take: of the content; whatever it raises means that the file is another.

    Raises:
        FileFormatError: the file is another, or damaged.
    """
    try:
        return take(torch.load(path, map_location="cpu", weights_only=True))
    except FileFormatError:
        raise
    except Exception as error:  # whatever a damaged file makes of itself
        raise FileFormatError(
            f"{key}: {path} is not {what}, or is damaged ({first_line(error):.200}); give a .ckpt file from the "
            "checkpoints folder of a training run"
        ) from error
