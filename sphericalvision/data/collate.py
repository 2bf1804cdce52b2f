# SPDX-License-Identifier: Apache-2.0
"""Samples into batches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, ShapeError, check_type

Sample = dict[str, Any]
"""Entries by name: images, rig, truth and so on."""


def collate_samples(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Make a batch of samples: tensors (also in dicts) are stacked, rigs become one batched rig.

    Anything else, such as the frames' names, becomes a list; so do rigs whose names, camera models or image sizes
    differ. Serves as ``collate_fn`` of a ``DataLoader``.

    Args:
        samples: dicts with the same keys; rigs may differ from sample to sample.

    Raises:
        ArgumentError: no samples, or keys differ.
        ShapeError: tensors of one key differ in shape; the message names key and shapes.

    Examples:
        >>> samples = [{"frame": "1", "valid": torch.ones(3)}, {"frame": "2", "valid": torch.ones(3)}]
        >>> batch = collate_samples(samples)
        >>> batch["frame"], batch["valid"].shape
        (['1', '2'], torch.Size([2, 3]))
    """
    if not samples:
        raise ArgumentError("samples: expected at least one sample to make a batch of, got none")
    for sample in samples:
        check_type("samples", sample, Mapping, "a dict with images, rig and so on")
    keys = list(samples[0])
    for sample in samples:
        if set(sample) != set(keys):
            raise ArgumentError(f"samples: expected the same keys in each, got {keys} and {list(sample)}")
    return {key: _collate_values(key, [sample[key] for sample in samples]) for key in keys}


def _collate_values(key: str, values: list[Any]) -> Any:
    first = values[0]
    if isinstance(first, torch.Tensor):
        shapes = [tuple(value.shape) for value in values]
        if len(set(shapes)) > 1:
            raise ShapeError(
                f"{key}: expected tensors of one shape to stack, got {shapes}; images of different cameras "
                "become alike on the icosphere (the ToSphere transform)"
            )
        return torch.stack(values)
    if isinstance(first, CameraRig):
        try:
            return CameraRig.stack(values)
        except ArgumentError:  # fisheyes and panoramas, for instance, have no parameters to put side by side
            return values
    if isinstance(first, Mapping):
        return {name: _collate_values(f"{key}.{name}", [value[name] for value in values]) for name in first}
    return values
