# SPDX-License-Identifier: Apache-2.0
"""Trainings that start from checkpoints, and errors that say why one does not fit."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch

from sphericalvision.core import ArgumentError, FileFormatError, first_line
from sphericalvision.models import DepthNetwork, IcoSweepNet, RefinedSweepNet
from sphericalvision.models.weights.checkpoints import read_network

Content = TypeVar("Content")


def initialize(net: DepthNetwork, weights: str | Path) -> None:
    """Start ``net`` from the parameters of another checkpoint, trained at any level.

    Those of an ``IcoSweepNet`` are for the prior of a ``RefinedSweepNet``, whose other parts stay as they are.

    Raises:
        ArgumentError: the other network is of another kind, number of cameras or channels; the message names both.
    """
    other = read_network(weights)
    if isinstance(net, RefinedSweepNet) and isinstance(other, IcoSweepNet):
        net = net.prior
    if type(other) is not type(net):
        raise ArgumentError(
            f"init_weights: {weights} is {type(other).__name__}, the network to train {type(net).__name__}"
        )
    state, expected = other.state_dict(), net.state_dict()
    if {name: tensor.shape for name, tensor in state.items()} != {n: t.shape for n, t in expected.items()}:
        refuse_others(weights, other.hyperparameters, net.hyperparameters, ("level", "min_depth"))
    net.load_state_dict(state)


def refuse_others(
    weights: str | Path, stored: Mapping[str, Any], current: Mapping[str, Any], free: Sequence[str] = ()
) -> None:
    """Refuse weights of other hyper-parameters, except for those that are ``free``.

    Raises:
        ArgumentError: hyper-parameters differ; the message has the values of both.
    """
    differing = [key for key in current if current[key] != stored.get(key) and key not in free]
    # None is a network's own choice, which may be the same: it is named where nothing else differs.
    if differing := [key for key in differing if current[key] is not None] or differing:
        raise ArgumentError(
            f"init_weights: {weights} has "
            + ", ".join(f"{key} = {stored.get(key)}" for key in differing)
            + f", the network to train has {', '.join(str(current[key]) for key in differing)}; set "
            + " ".join(f"model.{key}={stored.get(key)}" for key in differing)
            + " or take other weights"
        )


def read_checkpoint(key: str, path: Path, what: str, extract: Callable[[dict[str, Any]], Content]) -> Content:
    """Return what ``extract`` returns of the content of a Lightning checkpoint.

    Args:
        key: the key that names the file.
        path: the file.
        what: a name of the expected content, for the error.
        extract: takes the content; whatever it raises means that the file holds something else.

    Raises:
        FileFormatError: the file is another, or damaged.
    """
    try:
        return extract(torch.load(path, map_location="cpu", weights_only=True))
    except FileFormatError:
        raise
    except Exception as error:  # whatever a damaged file makes of itself
        raise FileFormatError(
            f"{key}: {path} is not {what}, or is damaged ({first_line(error):.200}); give a .ckpt file from the "
            "checkpoints folder of a training run"
        ) from error
