# SPDX-License-Identifier: Apache-2.0
"""Fixtures that every test may use."""

import gc
import importlib
import os
from pathlib import Path

import pytest
import torch
from hypothesis import settings

from tests import shape_checks

if "MUTANT_UNDER_TEST" not in os.environ:  # mutmut runs the tests again and again in one process
    shape_checks.install()  # before any test imports the package

# Tests are repeated to the last bit, whatever was compiled before; those of the operators ask for them.
os.environ.setdefault("SPHERICALVISION_KERNELS", "plain")

REGISTRIES = (
    ("sphericalvision.cameras.registry", "MODELS"),
    ("sphericalvision.cameras.calibration.formats", "FORMATS"),
    ("sphericalvision.models.weights.registry", "NETWORKS"),
    ("sphericalvision.scenes.registry", "KINDS"),
    ("sphericalvision.scenes.disturbances", "DISTURBANCES"),
    ("sphericalvision.sweep.aggregation", "AGGREGATIONS"),
)

settings.register_profile("repeatable", derandomize=True, deadline=None)  # a run fails by a change alone
settings.load_profile("repeatable")


gc.disable()  # until all tests are collected: nothing of what is imported meanwhile goes again


def pytest_collection_finish() -> None:
    """Keep modules and tests, millions of objects, out of the garbage collector's sight: they live until the end."""
    gc.freeze()
    gc.enable()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the laws of cameras, as Kornia's tests have them."""
    parser.addoption("--device", default="cpu", help="where laws run: cpu, cuda, mps")
    parser.addoption("--dtype", default="float32,float64", help="precisions in which laws run")


@pytest.fixture(scope="session")
def golden() -> Path:
    """Folder with outputs of the original authors' implementation; without it the test is skipped."""
    default = Path(__file__).resolve().parents[1].parent / "shared" / "golden"
    folder = Path(os.environ.get("SPHERICALVISION_GOLDEN", default))
    if not folder.is_dir():
        pytest.skip("reference numbers not found; set SPHERICALVISION_GOLDEN to their folder")
    return folder


@pytest.fixture
def generator() -> torch.Generator:
    """A random generator with a fixed seed."""
    return torch.Generator().manual_seed(0)


@pytest.fixture
def copied_registries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Examples add to copies of the registries: other tests look at all that is registered."""
    for module, name in REGISTRIES:
        registry = getattr(importlib.import_module(module), name)
        registry.names()  # all of the package's own are imported
        monkeypatch.setattr(registry, "things", dict(registry.things))
