# SPDX-License-Identifier: Apache-2.0
"""Weights on disk: safetensors with hyper-parameters inside, the authors' checkpoints, shipped ones."""

from sphericalvision.models.weights.files import load_weights, save_weights
from sphericalvision.models.weights.pretrained import available_weights, pretrained
from sphericalvision.models.weights.reference import load_reference_checkpoint, state_dict_from_reference
from sphericalvision.models.weights.registry import (
    network_class,
    network_name,
    network_names,
    register_network,
)

__all__ = [
    "available_weights",
    "load_reference_checkpoint",
    "load_weights",
    "network_class",
    "network_name",
    "network_names",
    "pretrained",
    "register_network",
    "save_weights",
    "state_dict_from_reference",
]
