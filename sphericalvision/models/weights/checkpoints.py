# SPDX-License-Identifier: Apache-2.0
"""A network from any file of weights that this package knows, or by the name of weights that ship."""

from __future__ import annotations

from pathlib import Path

import torch

from sphericalvision.core import ArgumentError, FileFormatError, check_file, first_line
from sphericalvision.models.depth_network import DepthNetwork
from sphericalvision.models.weights.files import load_weights
from sphericalvision.models.weights.filling import make_network
from sphericalvision.models.weights.pretrained import STUDY, available_weights, pretrained
from sphericalvision.models.weights.registry import network_class

REFERENCE_SUFFIXES = (".pth", ".pt", ".tar")
"""Of checkpoints in the authors' format."""
WRAPPERS = ("_orig_mod.", "module.")
"""In front of the names of all weights of a network within ``torch.compile`` or a parallel module."""


def read_network(source: str | Path | None = None) -> DepthNetwork:
    """Return the network of a file, of a training's checkpoint, or of weights that ship, on the CPU and in eval mode.

    Args:
        source: ``.safetensors``, a ``.ckpt`` of a training, or ``.pth`` in the format of the authors of IcoSweepNet or
            RomniStereo; or the name of weights that ship with the package, by default ``refinedsweepnet``.

    Raises:
        ArgumentError: the suffix is of no known format.
        MissingFileError: no such file.
        FileFormatError: the file holds no network of this package.

    Examples:
        >>> type(read_network("icosweepnet-small")).__name__
        'IcoSweepNet'
    """
    if source is None:
        return pretrained()
    if str(source) in (*available_weights(), *STUDY) and not Path(source).exists():
        return pretrained(str(source))
    names = ", ".join(available_weights())
    path = check_file(source, f"a checkpoint (.safetensors, .ckpt, or the authors' format) or one of {names}")
    if path.suffix == ".safetensors":
        return load_weights(path)
    if path.suffix in REFERENCE_SUFFIXES:
        from sphericalvision.models.weights.reference import load_reference_checkpoint
        from sphericalvision.models.weights.romnistereo_checkpoint import (
            is_romnistereo,
            load_romnistereo_checkpoint,
        )

        return (load_romnistereo_checkpoint if is_romnistereo(path) else load_reference_checkpoint)(path)
    if path.suffix != ".ckpt":
        suffixes = ", ".join((".safetensors", ".ckpt", *REFERENCE_SUFFIXES))
        raise ArgumentError(f"checkpoint: {path} has none of the suffixes of checkpoints, {suffixes}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        state = {key[4:]: value for key, value in content["state_dict"].items() if key.startswith("net.")}
        for prefix in WRAPPERS:
            if state and all(key.startswith(prefix) for key in state):
                state = {key.removeprefix(prefix): value for key, value in state.items()}
        network = network_class(content["architecture"])
        return make_network(network, content["network_hyperparameters"], state, path).eval()
    except FileFormatError:
        raise
    except Exception as error:  # whatever a damaged file makes of itself
        raise FileFormatError(
            f"{path}: is not a checkpoint of sphericalvision-train, or is damaged "
            f"({first_line(error):.200}). Give a .ckpt or .safetensors file from the "
            "checkpoints folder of a training run."
        ) from error
