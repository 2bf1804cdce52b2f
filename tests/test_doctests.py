# SPDX-License-Identifier: Apache-2.0
"""Every example in a docstring runs and prints what it says."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
from pathlib import Path

import pytest
import torch

import sphericalvision

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
MODULES = sorted(info.name for info in pkgutil.walk_packages(sphericalvision.__path__, "sphericalvision."))


REGISTRIES = (
    ("sphericalvision.cameras.registry", "MODELS"),
    ("sphericalvision.cameras.calibration.formats", "FORMATS"),
    ("sphericalvision.models.weights.registry", "NETWORKS"),
    ("sphericalvision.scenes.registry", "KINDS"),
    ("sphericalvision.scenes.disturbances", "DISTURBANCES"),
    ("sphericalvision.sweep.aggregation", "AGGREGATIONS"),
)
"""Examples add to copies of these: other tests look at all that is registered."""


@pytest.mark.parametrize("name", MODULES)
def test_examples_of_module(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    for module, name_of_registry in REGISTRIES:
        registry = getattr(importlib.import_module(module), name_of_registry)
        registry.names()  # all of the package's own are imported
        monkeypatch.setattr(registry, "things", dict(registry.things))
    result = doctest.testmod(importlib.import_module(name), optionflags=FLAGS)
    assert result.failed == 0, f"{result.failed} of {result.attempted} examples of {name} fail; see above"
