# SPDX-License-Identifier: Apache-2.0
"""Files of weights: safetensors that say which network they are of and with which hyper-parameters."""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Literal

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, FileFormatError, check_choice, check_file
from sphericalvision.io.files import atomic_write
from sphericalvision.models.depth_network import DepthNetwork
from sphericalvision.models.weights.filling import make_network
from sphericalvision.models.weights.registry import network_class, network_name

PREFIX = "sphericalvision-"
"""What the names of networks begin with in files."""


LARGE = 20_000
"""Numbers in a tensor, from which on fewer bits are worth it."""
MEDIUM = 2_000
"""Numbers, from which on half precision is worth it where large tensors have eight bits."""
STEP = ".step"
"""Ends the name of the steps, one for each output, that the numbers of a tensor of eight bits are counted in."""


def save_weights(net: DepthNetwork, path: str | Path, bits: Literal[32, 16, 8] = 32) -> Path:
    """Write the weights, hyper-parameters and name of a network to a ``.safetensors`` file, folders included.

    Args:
        net: any network that has a name; of one that ``torch.compile`` or a parallel module wraps, the one inside.
        path: ends in ``.safetensors``.
        bits: of each number in tensors of 20,000 and more. 16, half precision, nearly halves the file, and what the
            network answers may change in the last digits. With 8 they are multiples of a step of each output's own,
            within half a step, and tensors of 2,000 numbers and more are in half precision: about a quarter of the
            file. Tensors with numbers that half precision does not hold stay as they are. All are read as float32
            again.

    Raises:
        ArgumentError: if the file's name does not end in ``.safetensors``, ``bits`` is another number, or the network
            has no name (``register_network``) or hyper-parameters that no file can hold.
        OSError: if the file cannot be written.

    Examples:
        >>> from sphericalvision.models import IcoSweepNet
        >>> save_weights(IcoSweepNet(level=3, num_hypotheses=4, feature_channels=2), "net.safetensors").name
        'net.safetensors'
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ArgumentError(f"path: expected a name ending in .safetensors, got {path.name!r}")
    check_choice("bits", bits, (32, 16, 8))
    while isinstance(inside := getattr(net, "_orig_mod", getattr(net, "module", None)), nn.Module):
        net = inside  # type: ignore[assignment]
    metadata = {"format": PREFIX + network_name(net), "hyperparameters": json.dumps(net.hyperparameters)}
    state = {name: tensor.detach().cpu().contiguous() for name, tensor in net.state_dict().items()}
    state = {name: kept for whole in state.items() for name, kept in with_bits(*whole, bits)}
    with atomic_write(path) as temporary:
        try:
            save_file(state, temporary, metadata)
            _sort_metadata(temporary)
        except SafetensorError as error:  # of a full disk, for instance
            raise OSError(errno.EIO, f"could not be written: {error}", str(path)) from error
    return path


def _sort_metadata(path: Path) -> None:
    """Bring metadata into the order of their names, so that equal weights are equal files: safetensors draws it."""
    with path.open("r+b") as file:
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
        text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
        assert len(text) <= size, "the same values in another order"
        file.seek(8)
        file.write(text.ljust(size))


def with_bits(name: str, tensor: Tensor, bits: int) -> Iterator[tuple[str, Tensor]]:
    """A tensor as it is stored, and the steps that its numbers are counted in."""
    size = tensor.numel() if tensor.is_floating_point() else 0
    if bits == 8 and size >= LARGE:
        step = tensor.abs().reshape(len(tensor), -1).amax(1).reshape(_steps_shape(tensor)) / 127
        step = step.clamp_min(torch.finfo(step.dtype).tiny)  # of an output whose weights are all zero
        yield name, (tensor / step).round().to(torch.int8)
        yield name + STEP, step
    else:
        half = size >= (LARGE if bits == 16 else MEDIUM) and bits < 32
        fits = half and bool(tensor.abs().amax() <= torch.finfo(torch.half).max)  # else it would be infinite
        yield name, tensor.half() if fits else tensor


def _as_float32(stored: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    """Tensors of a file as a network has them."""
    steps = {
        name: stored.pop(name + STEP) for name in list(stored) if name + STEP in stored and name in stored
    }
    if orphans := [name for name in steps if name not in stored]:
        raise FileFormatError(
            f"{path}: '{orphans[0]}' is a step, and has a step of its own; the file is damaged"
        )
    for name, step in steps.items():
        if step.shape != _steps_shape(stored[name]):
            raise FileFormatError(
                f"{path}: '{name}{STEP}' has shape {tuple(step.shape)}, expected {_steps_shape(stored[name])}"
            )
        stored[name] = stored[name] * step
    return {name: x.float() if x.dtype == torch.half else x for name, x in stored.items()}


def _steps_shape(tensor: Tensor) -> tuple[int, ...]:
    return (*tensor.shape[:1], *[1] * (tensor.dim() - 1))


def identity_of(net: DepthNetwork) -> str:
    """Characters that change with a network's class, hyper-parameters and weights."""
    digest = sha256(repr((type(net).__name__, net.hyperparameters)).encode())
    for key, tensor in net.state_dict().items():
        digest.update(key.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


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
            state = _as_float32(stored, path)
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
        return make_network(network, json.loads(metadata["hyperparameters"]), state, path).eval()
    except FileFormatError:
        raise
    except Exception as error:  # whatever a stranger's hyper-parameters make of themselves
        raise FileFormatError(
            f"{path}: cannot build {network.__name__} from metadata 'hyperparameters' = "
            f"{metadata['hyperparameters']:.1000}: {error}"
        ) from error
