# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of the authors' release of IcoSweepNet: read, and their parameters renamed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.core import FileFormatError, check_file, first_line
from sphericalvision.models.icosweepnet import IcoSweepNet
from sphericalvision.models.weights.filling import load_state

# Module names of the authors' release and ours; index tables (w1_index, w2_index) are not weights.
_REFERENCE_PREFIXES = {
    "feature_extraction.conv1": "features.entry",
    "feature_extraction.conv2": "features.second",
    **{
        f"feature_extraction.{theirs}.{block}.convbn{k}": f"features.{ours}.{block}.{name}"
        for theirs, ours, count in (("layer1", "fine", 3), ("layer2", "coarse", 5))
        for block in range(count)
        for k, name in ((1, "first"), (2, "second"))
    },
    "feature_extraction.lastconv": "features.last",
    **{
        f"cost_regularization.dres0.{k}": f"regularizer.fusion.{n}" for k, n in enumerate(("first", "second"))
    },
    **{
        f"cost_regularization.dres{block + 1}.{k}": f"regularizer.blocks.{block}.{name}"
        for block in range(4)
        for k, name in enumerate(("first", "second"))
    },
    "cost_regularization.classify.0": "regularizer.reduction",
    "cost_regularization.classify.1": "regularizer.score",
}


def load_reference_checkpoint(
    path: str | Path,
    level: int | None = None,
    num_hypotheses: int | None = None,
    min_depth: float | None = None,
) -> IcoSweepNet:
    """Return the network of a checkpoint of the authors' release, on the CPU and in eval mode.

    Such a file is a pickled dictionary with ``state_dict``, ``ndisp`` (N), ``min_depth`` (m) and ``level``
    (of the images). Weights do not depend on the last three, so each can be overridden. Widths follow from
    the weights. Nothing but tensors and plain values is unpickled.

    Args:
        path: the checkpoint.
        level: of the images, in place of the checkpoint's.
        num_hypotheses: in place of the checkpoint's ``ndisp``.
        min_depth: in metres, in place of the checkpoint's.

    Raises:
        MissingFileError: if there is no such file.
        FileFormatError: if an entry is missing, foreign or of another size than the network's; the message
            names it.

    Examples:
        >>> net = load_reference_checkpoint("icosweepnet.pth")  # doctest: +SKIP
        >>> net.level, net.num_hypotheses, net.min_depth  # doctest: +SKIP
        (7, 32, 0.55)
    """
    path = check_file(path, "a checkpoint with state_dict, ndisp, min_depth and level")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever a damaged file makes of itself
        raise FileFormatError(
            f"{path}: not a checkpoint of tensors and plain values: {first_line(error)}"
        ) from error
    if not isinstance(checkpoint, Mapping) or not isinstance(checkpoint.get("state_dict"), Mapping):
        content = (
            ", ".join(map(str, list(checkpoint)[:4])) if isinstance(checkpoint, Mapping) else "no dictionary"
        )
        raise FileFormatError(
            f"{path}: expected the key 'state_dict', 'ndisp', 'min_depth' and 'level', found {content}"
        )
    settings: dict[str, Any] = {
        "level": checkpoint.get("level") if level is None else level,
        "num_hypotheses": checkpoint.get("ndisp") if num_hypotheses is None else num_hypotheses,
        "min_depth": checkpoint.get("min_depth") if min_depth is None else min_depth,
    }
    for (name, value), key in zip(settings.items(), ("level", "ndisp", "min_depth"), strict=True):
        if value is None:
            raise FileFormatError(
                f"{path}: the key '{key}' is missing; pass {name}= to load_reference_checkpoint"
            )
    state = state_dict_from_reference(checkpoint["state_dict"], path)
    try:
        channels = state["features.last.weight"].shape[0]
        num_cameras = state["regularizer.fusion.first.conv.weight"].shape[1] // channels
    except (KeyError, IndexError, ZeroDivisionError) as error:
        raise FileFormatError(
            f"{path}: feature_extraction.lastconv.weight or cost_regularization.dres0.0.conv.weight is missing "
            "or has no channels, so the widths of the network are unknown"
        ) from error
    try:
        net = IcoSweepNet(
            level=int(settings["level"]),
            num_hypotheses=int(settings["num_hypotheses"]),
            min_depth=float(settings["min_depth"]),
            feature_channels=channels,
            num_cameras=num_cameras,
        )
    except (TypeError, ValueError) as error:
        raise FileFormatError(f"{path}: no network has these settings ({settings}): {error}") from error
    return load_state(net, state, path).eval()


def state_dict_from_reference(
    state_dict: Mapping[str, Any], source: str | Path = "state_dict"
) -> dict[str, Tensor]:
    """Return the state dictionary of ``IcoSweepNet`` of one in the authors' names; index tables are dropped.

    Args:
        state_dict: the authors' names and tensors; a ``module.`` before every name (from ``DataParallel``) is
            allowed.
        source: what the dictionary was read from, for messages.

    Raises:
        FileFormatError: if a name does not belong to the authors' network.

    Examples:
        >>> list(state_dict_from_reference({"module.feature_extraction.conv1.bn.weight": torch.ones(32)}))
        ['features.entry.norm.weight']
    """
    state = {}
    for key, tensor in state_dict.items():
        name = key.removeprefix("module.")
        if name.endswith(("w1_index", "w2_index")):
            continue
        prefix = max((p for p in _REFERENCE_PREFIXES if name.startswith(p + ".")), key=len, default=None)
        if prefix is None or not isinstance(tensor, Tensor):
            raise FileFormatError(
                f"{source}: the key '{key}' is not a tensor of the authors' IcoSweepNet; "
                "is this a checkpoint of another network?"
            )
        state[_REFERENCE_PREFIXES[prefix] + name[len(prefix) :].replace(".bn.", ".norm.")] = tensor
    return state
