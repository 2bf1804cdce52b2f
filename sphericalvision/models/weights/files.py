# SPDX-License-Identifier: Apache-2.0
"""Files of weights: safetensors that say which network they are of and with which hyper-parameters."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from sphericalvision.core import ArgumentError, FileFormatError, check_file
from sphericalvision.io.files import atomic_write
from sphericalvision.models.base import DepthNetwork
from sphericalvision.models.weights.filling import made
from sphericalvision.models.weights.registry import network_class, network_name

__all__ = ["load_weights", "save_weights"]

PREFIX = "sphericalvision-"
"""What the names of networks begin with in files."""


LARGE = 20_000
"""Numbers in a tensor, from which on half precision is worth it."""


def save_weights(net: DepthNetwork, path: str | Path, half: bool = False) -> Path:
    """Write the weights, hyper-parameters and name of a network to a ``.safetensors`` file, folders included.

    Args:
        net: any network that has a name.
        path: ends in ``.safetensors``.
        half: whether tensors of 20,000 numbers and more are stored in half precision, which nearly halves the file.
            They are read as float32 again; what the network answers may change in the last digits.

    Raises:
        ArgumentError: if the file's name does not end in ``.safetensors``, or the network has no name
            (``register_network``) or hyper-parameters that no file can hold.
        OSError: if the file cannot be written.

    Examples:
        >>> from sphericalvision.models import IcoSweepNet
        >>> save_weights(IcoSweepNet(level=3, num_hypotheses=4, feature_channels=2), "net.safetensors").name
        'net.safetensors'
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ArgumentError(f"path: expected a name ending in .safetensors, got {path.name!r}")
    metadata = {"format": PREFIX + network_name(net), "hyperparameters": json.dumps(net.hyperparameters)}
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in net.state_dict().items()}
    if half:
        large = {name: x for name, x in state.items() if x.is_floating_point() and x.numel() >= LARGE}
        state |= {name: tensor.half() for name, tensor in large.items()}
    with atomic_write(path) as temporary:
        try:
            save_file(state, temporary, metadata)
        except SafetensorError as error:  # of a full disk, for instance
            raise OSError(errno.EIO, f"could not be written: {error}", str(path)) from error
    return path


def load_weights(path: str | Path) -> DepthNetwork:
    """Return the network that ``save_weights`` wrote, whichever it is, on the CPU and in eval mode.

    Raises:
        MissingFileError: if there is no such file.
        FileFormatError: if it is no such file, or its weights do not fit its hyper-parameters.

    Examples:
        >>> from sphericalvision.models import IcoSweepNet
        >>> path = save_weights(IcoSweepNet(level=3, num_hypotheses=4, feature_channels=2), "net.safetensors")
        >>> load_weights(path).num_hypotheses
        4
    """
    path = check_file(path, "weights written by save_weights")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            stored = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
            state = {name: x.float() if x.dtype == torch.half else x for name, x in stored.items()}
    except SafetensorError as error:
        raise FileFormatError(
            f"{path}: not a readable safetensors file ({error}); for a checkpoint of the authors' release "
            "use load_reference_checkpoint"
        ) from error
    kind = metadata.get("format", "")
    if not kind.startswith(PREFIX) or "hyperparameters" not in metadata:
        raise FileFormatError(
            f"{path}: no hyper-parameters of a network inside (metadata 'format' is {metadata.get('format')!r}, "
            f"expected {PREFIX} and the name of a network); write weights with save_weights"
        )
    try:
        network = network_class(kind.removeprefix(PREFIX))
    except ArgumentError as error:
        raise FileFormatError(f"{path}: holds the weights of an unknown network: {error}") from error
    try:
        state = network.updated_weights(state)
        return made(network, json.loads(metadata["hyperparameters"]), state, path).eval()
    except FileFormatError:
        raise
    except Exception as error:  # whatever a stranger's hyper-parameters make of themselves
        raise FileFormatError(
            f"{path}: cannot build {network.__name__} from metadata 'hyperparameters' = "
            f"{metadata['hyperparameters']:.1000}: {error}"
        ) from error
