# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of the release of RomniStereo's authors: read without running code, and their parameters renamed."""

from __future__ import annotations

import zipfile
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sphericalvision.core import FileFormatError, check_file, first_line
from sphericalvision.models.romnistereo import PYRAMID, RADIUS, RomniStereo
from sphericalvision.models.weights.filling import load_state

BUILT_IN = {
    "encoder_downsample_twice": False,
    "num_downsample": 1,
    "corr_levels": PYRAMID,
    "corr_radius": RADIUS,
}
"""Options of the authors that this network has in one value."""

PREFIXES = {
    "encoder.layers.0": "features.entry",
    **{
        f"encoder.layers.{2 * block + k}": f"features.blocks.{block}.{name}"
        for block in range(8)
        for k, name in ((1, "first"), (2, "second"))
    },
    "encoder.layers.17": "features.last",
    **{
        f"volume_gen.{volume}_mapping.linear{k}": f"{volume}.{name}"
        for volume in ("reference", "target")
        for k, name in ((1, "first"), (2, "second"))
    },
    "state_conv": "initial",
    **{
        f"update_block.encoder.conv{letter}{k + 1}": f"update.{name}.{k}"
        for letter, name in (("c", "correlation"), ("d", "index"))
        for k in range(2)
    },
    "update_block.encoder.conv": "update.motion",
    "update_block.gru.convz": "update.keep",
    "update_block.gru.convr": "update.reset",
    "update_block.gru.convq": "update.proposal",
    **{f"update_block.depth_head.conv{k + 1}": f"update.step.{k}" for k in range(2)},
    "update_block.mask.0": "update.weights.0",
    "update_block.mask.2": "update.weights.1",
}
"""Modules of the authors and ours."""
NORMALISED = {".conv.": ".0.", ".bn.": ".1."}
"""Parts of a convolution with its normalisation."""


def is_romnistereo(path: Path) -> bool:
    """Whether a file of torch has the entry that checkpoints of RomniStereo keep their weights in."""
    if not zipfile.is_zipfile(path):
        return False
    try:
        with zipfile.ZipFile(path) as file:
            (name,) = (name for name in file.namelist() if name.endswith("/data.pkl"))
            # Names of weights are within the first kilobytes
            return b"net_state_dict" in file.open(name).read(2**20)
    except (
        ValueError,
        OSError,
        RuntimeError,
        zipfile.BadZipFile,
    ):  # damaged: whoever reads it next will say so
        return False


def load_romnistereo_checkpoint(
    path: str | Path, min_depth: float = 0.55, output_size: Sequence[int] = (160, 640)
) -> RomniStereo:
    """Return the network of a checkpoint of the authors' release, on the CPU and in eval mode.

    Such a file is a pickled dictionary with ``net_state_dict`` and ``net_opts``, an object of a class of the authors.
    No class of the file is imported: what is neither a tensor nor plain becomes a dictionary. Offsets of convolutions
    before a normalisation, which change nothing but its mean, are taken from that mean.

    Args:
        path: the checkpoint.
        min_depth: radius of the nearest sphere in metres, which the file does not tell.
        output_size: (height, width) of the panorama, on which weights do not depend.

    Raises:
        MissingFileError: if there is no such file.
        FileFormatError: if an entry is missing, foreign or of another size than the network's, or an option is not
            that of the published network; the message names it.

    Examples:
        >>> net = load_romnistereo_checkpoint("romnistereo32.pth")  # doctest: +SKIP
        >>> net.num_hypotheses, net.hyperparameters["feature_channels"]  # doctest: +SKIP
        (192, 32)
    """
    path = check_file(path, "a checkpoint with net_state_dict and net_opts")
    try:
        classes = torch.serialization.get_unsafe_globals_in_checkpoint(path)
        with torch.serialization.safe_globals([(OrderedDict, name) for name in classes]):
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        state, options = checkpoint["net_state_dict"], checkpoint["net_opts"]
        options = {**vars(options), **options} if isinstance(options, OrderedDict) else dict(options)
        state = {str(name).removeprefix("module."): tensor for name, tensor in state.items()}
    except Exception as error:  # whatever a damaged file makes of itself
        raise FileFormatError(
            f"{path}: not a checkpoint of RomniStereo (net_state_dict, net_opts): {first_line(error):.200}; "
            "a file of torch before 1.6 has to be saved again by a newer one"
        ) from error
    for name, value in BUILT_IN.items():
        if options.get(name, value) != value:
            raise FileFormatError(f"{path}: {name}: expected {value}, as published, got {options[name]!r}")
    try:
        net = RomniStereo(
            num_hypotheses=int(options["num_invdepth"]),
            min_depth=min_depth,
            feature_channels=int(options["base_channel"]),
            output_size=output_size,
            in_channels=3 if options.get("use_rgb") else 1,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FileFormatError(
            f"{path}: net_opts: no network has these options ({options}): {error}"
        ) from error
    return load_state(net, _renamed(state, path), path).eval()


def _renamed(state: Mapping[str, Any], path: Path) -> dict[str, Tensor]:
    """The weights under our names, without offsets before a normalisation."""
    renamed = {}
    for key, tensor in state.items():
        prefix = next((p for p in PREFIXES if key.startswith(f"{p}.")), None)
        if prefix is None or not isinstance(tensor, Tensor):
            raise FileFormatError(f"{path}: the key '{key}' is not a tensor of the authors' RomniStereo")
        if key == f"{prefix}.conv.bias" and f"{prefix}.bn.running_mean" in state:
            continue
        if key.endswith(".bn.running_mean") and f"{prefix}.conv.bias" in state:
            tensor = tensor - state[f"{prefix}.conv.bias"]
        name = key.removeprefix(prefix)
        for theirs, ours in NORMALISED.items():
            name = name.replace(theirs, ours)
        renamed[PREFIXES[prefix] + name] = tensor
    return renamed
