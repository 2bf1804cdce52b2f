# SPDX-License-Identifier: Apache-2.0
"""What importing each room loads: what it is made of, and nothing that only others need."""

import pytest

from tests.processes import modules_after, python

HEAVY = ("matplotlib", "trimesh", "kornia", "cv2", "skimage", "torchmetrics", "hydra", "pytorch_lightning")

BELOW = {"sphericalvision", *(f"sphericalvision.{name}" for name in ("core", "kernels", "shapes", "tables"))}
"""What every room may load."""

ROOMS = {
    "sphericalvision": ((), 1),
    "sphericalvision.cameras": ((), 4),
    "sphericalvision.crown": ((), 4),
    "sphericalvision.models": ((), 4),
    "sphericalvision.cameras.models.ocam": (("cameras", "geometry", "extensions"), 35),
    "sphericalvision.cameras.rig": (("cameras", "geometry", "extensions"), 30),
    "sphericalvision.icosphere.icosphere": (("icosphere", "geometry"), 30),
    "sphericalvision.crown.conv": (("crown", "icosphere", "geometry"), 60),
    "sphericalvision.crown.hexconv": (("crown", "icosphere", "geometry"), 60),
    "sphericalvision.sphere.grids.healpix": (("sphere", "geometry"), 30),
    "sphericalvision.losses.depth_loss": (("losses", "sphere", "icosphere", "geometry"), 40),
    "sphericalvision.sweep.regression": (("sweep",), 10),
    "sphericalvision.sweep.aggregation": (("sweep", "cameras", "icosphere", "geometry", "extensions"), 50),
    "sphericalvision.models.icosweepnet": (
        ("models", "crown", "sweep", "sphere", "icosphere", "cameras", "geometry", "extensions"),
        110,
    ),
}
"""The modules and rooms that may be loaded with it, and how many modules of this package in all."""


@pytest.fixture(scope="module")
def loaded() -> dict[str, set[str]]:
    """The modules that importing each room loads."""
    return dict(zip(ROOMS, modules_after(*(f"import {room}" for room in ROOMS)), strict=True))


@pytest.mark.parametrize("module", ROOMS)
def test_a_room_loads_what_it_is_made_of(module: str, loaded: dict[str, set[str]]) -> None:
    rooms, most = ROOMS[module]
    found = loaded[module]
    ours = {name for name in found if name.split(".")[0] == "sphericalvision"}
    allowed = {*BELOW, *(f"sphericalvision.{room}" for room in rooms)}
    strange = {name for name in ours - {module} if ".".join(name.split(".")[:2]) not in allowed}
    assert not strange
    assert not found & set(HEAVY)
    assert not {name for name in ours if name.startswith("sphericalvision.cameras.calibration")}
    assert len(ours) <= most, f"{len(ours)} modules: {sorted(ours)}"


def test_calibration_formats_and_cameras_are_found_without_having_been_imported() -> None:
    program = """
from sphericalvision.cameras.registry import camera_model, camera_model_names
assert camera_model("ocam").__name__ == "OCamCamera"
import sys
assert "sphericalvision.cameras.models.atan" not in sys.modules
assert {"atan", "ocam", "pinhole"} <= set(camera_model_names())
from sphericalvision.cameras.calibration import CAMERA_FORMATS, RIG_FORMATS
assert {"native", "kalibr"} <= set(CAMERA_FORMATS) & set(RIG_FORMATS)
from sphericalvision.models.weights.registry import network_class
assert network_class("semi-global-sweep").__name__ == "SemiGlobalSweep"
"""
    python("-c", program)
