# SPDX-License-Identifier: Apache-2.0
"""Every camera of ``tests/laws/cameras.py`` obeys every law, in single and double precision."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from types import ModuleType

import pytest
import torch

from sphericalvision import cameras
from sphericalvision.cameras import Camera
from tests.laws import camera_laws, differentiation_laws
from tests.laws.cameras import CAMERAS, CameraCase

Law = Callable[..., None]


def laws_of(module: ModuleType) -> dict[str, Law]:
    """All functions of a module whose names begin with ``law_``, by the rest of the name."""
    return {
        name.removeprefix("law_"): law
        for name, law in vars(module).items()
        if name.startswith("law_") and law.__module__ == module.__name__
    }


def obey(law: Law, case: CameraCase, dtype: torch.dtype, **more: object) -> None:
    """Call a law with those of its arguments that it names."""
    camera = case.make(1.0).to(dtype)
    known = {
        "camera": camera,
        "other": case.make(1.1).to(dtype),
        "case": case,
        "tolerance": case.own_tolerance + camera_laws.pixel_precision(camera),
        **more,
    }
    try:
        law(**{name: known[name] for name in inspect.signature(law).parameters})
    except AssertionError as error:
        error.add_note(f"of {camera}")
        raise


def test_a_law_that_fails_says_which_camera_and_which_point() -> None:
    def law_nothing_is_seen(camera: Camera) -> None:
        points = camera_laws.directions_within(camera, 4)
        camera_laws.hold_everywhere(~camera.project(points).valid, points, "nothing is seen")

    with pytest.raises(AssertionError, match=r"not so at 4 of 4, the first at \[") as failure:
        obey(law_nothing_is_seen, CAMERAS[0], torch.float64)
    assert type(CAMERAS[0].make(1.0)).__name__ in failure.value.__notes__[0]


def test_every_camera_of_the_package_has_a_case() -> None:
    offered = {
        found for found in vars(cameras).values() if inspect.isclass(found) and issubclass(found, Camera)
    }
    assert offered - {Camera} == {type(case.make(1.0)) for case in CAMERAS}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A law runs in the precisions and on the device that the command line asks for."""
    if "precision" in metafunc.fixturenames:
        names = metafunc.config.getoption("--dtype").split(",")
        metafunc.parametrize("precision", [getattr(torch, name) for name in names], ids=names)


@pytest.mark.parametrize("case", CAMERAS, ids=lambda case: case.name)
@pytest.mark.parametrize("law", laws_of(camera_laws).values(), ids=laws_of(camera_laws))
def test_law(law: Law, case: CameraCase, precision: torch.dtype, pytestconfig: pytest.Config) -> None:
    with torch.device(pytestconfig.getoption("--device")):  # what a law makes without saying where
        obey(law, case, precision)


@pytest.mark.parametrize("case", CAMERAS, ids=lambda case: case.name)
def test_each_parameter_alone_may_be_batched(case: CameraCase) -> None:
    obey(camera_laws.each_parameter_alone_may_be_batched, case, torch.float64)


@pytest.mark.parametrize("case", CAMERAS, ids=lambda case: case.name)
@pytest.mark.parametrize("law", laws_of(differentiation_laws).values(), ids=laws_of(differentiation_laws))
def test_law_of_derivatives(law: Law, case: CameraCase) -> None:
    obey(law, case, torch.float64)


TRACED = [case if case.traced else pytest.param(case, marks=pytest.mark.slow) for case in CAMERAS]


@pytest.mark.parametrize("case", TRACED, ids=[case.name for case in CAMERAS])
def test_compiles_without_graph_breaks(case: CameraCase) -> None:
    obey(differentiation_laws.compiles_without_graph_breaks, case, torch.float64, backend="eager")


@pytest.mark.parametrize("case", TRACED, ids=[case.name for case in CAMERAS])
def test_exports(case: CameraCase) -> None:
    obey(differentiation_laws.exports, case, torch.float64)


@pytest.mark.slow
@pytest.mark.parametrize("case", CAMERAS, ids=lambda case: case.name)
def test_compiled_gradients(case: CameraCase) -> None:
    obey(differentiation_laws.compiled_gradients, case, torch.float64, backend="aot_eager")


@pytest.mark.slow
@pytest.mark.parametrize("case", CAMERAS, ids=lambda case: case.name)
def test_compiles_to_machine_code(case: CameraCase) -> None:
    obey(differentiation_laws.compiles_without_graph_breaks, case, torch.float64, backend="inductor")
