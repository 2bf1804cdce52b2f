# SPDX-License-Identifier: Apache-2.0
"""Every example in a docstring runs and prints what it says."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

import sphericalvision

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
MODULES = sorted(info.name for info in pkgutil.walk_packages(sphericalvision.__path__, "sphericalvision."))


@pytest.mark.usefixtures("copied_registries")
@pytest.mark.parametrize(
    "name", [name for name in MODULES if not name.endswith("_triton") or find_spec("triton")]
)
def test_examples_of_module(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    result = doctest.testmod(importlib.import_module(name), optionflags=FLAGS)
    assert result.failed == 0, f"{result.failed} of {result.attempted} examples of {name} fail; see above"
