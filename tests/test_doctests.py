# SPDX-License-Identifier: Apache-2.0
"""Every example in a docstring runs and prints what it says."""

import doctest
import importlib
import pkgutil
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

import sphericalvision
import sphericalvision.recipes

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
# The recipes are a folder of their own until a wheel is built: an editable install has no path from one to the other.
MODULES = sorted(
    {
        info.name
        for package in (sphericalvision, sphericalvision.recipes)
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if not info.name.endswith("__main__")  # which is a command
    }
)


@pytest.mark.usefixtures("copied_registries")
@pytest.mark.parametrize(
    "name", [name for name in MODULES if not name.endswith("_triton") or find_spec("triton")]
)
def test_examples_of_module(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    result = doctest.testmod(importlib.import_module(name), optionflags=FLAGS)
    assert result.failed == 0, f"{result.failed} of {result.attempted} examples of {name} fail; see above"
