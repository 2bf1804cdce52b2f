# SPDX-License-Identifier: Apache-2.0
"""Networks, composed of the rooms below, and their weights."""

from sphericalvision.models.base import DepthNetwork
from sphericalvision.models.classifier import SphereClassifier
from sphericalvision.models.icosweepnet import IcoSweepNet
from sphericalvision.models.omnimvs import OmniMVS
from sphericalvision.models.refinedsweepnet import RefinedSweepNet
from sphericalvision.models.segmenter import SphereSegmenter
from sphericalvision.models.training_free import SemiGlobalSweep, WinnerTakesAll
from sphericalvision.models.weights import (
    available_weights,
    load_reference_checkpoint,
    load_weights,
    pretrained,
    register_network,
    save_weights,
    state_dict_from_reference,
)

__all__ = [
    "DepthNetwork",
    "IcoSweepNet",
    "OmniMVS",
    "RefinedSweepNet",
    "SemiGlobalSweep",
    "SphereClassifier",
    "SphereSegmenter",
    "WinnerTakesAll",
    "available_weights",
    "load_reference_checkpoint",
    "load_weights",
    "pretrained",
    "register_network",
    "save_weights",
    "state_dict_from_reference",
]
