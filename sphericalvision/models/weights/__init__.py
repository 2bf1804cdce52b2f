# SPDX-License-Identifier: Apache-2.0
"""Weights on disk: safetensors with hyper-parameters inside, the authors' checkpoints, shipped ones."""

from sphericalvision.models.weights.files import (
    available_weights,
    load_reference_checkpoint,
    load_weights,
    pretrained,
    save_weights,
    state_dict_from_reference,
)

__all__ = [
    "available_weights",
    "load_reference_checkpoint",
    "load_weights",
    "pretrained",
    "save_weights",
    "state_dict_from_reference",
]
