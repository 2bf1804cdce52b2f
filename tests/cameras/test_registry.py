# SPDX-License-Identifier: Apache-2.0
"""A camera model of one's own: written once, known to files, rigs and conversions by its name."""

from __future__ import annotations

import math
from importlib import metadata
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import (
    Camera,
    CameraRig,
    FisheyeCamera,
    PinholeCamera,
    Projection,
    Unprojection,
    convert,
    read_camera,
    read_rig,
    register_camera,
    save_camera,
)
from sphericalvision.cameras.declaration import ImageSize, Intrinsic, MaxAngle
from sphericalvision.cameras.fitting import fitted, shape_grid
from sphericalvision.cameras.registry import MODELS
from sphericalvision.core import ArgumentError, FileFormatError


def project_parabolic(
    points: Tensor, focal_length: Tensor, principal_point: Tensor, bend: Tensor
) -> Projection:
    """A camera that nobody built: a stereographic mirror, stretched by ``bend``."""
    x, y, z = points.unbind(-1)
    total = points.norm(dim=-1) * bend + z
    shrink = 1 / total.clamp_min(1e-6)
    pixels = torch.stack((x * shrink, y * shrink), -1) * focal_length + principal_point
    return Projection(pixels, total > 1e-6)


def unproject_parabolic(
    pixels: Tensor, focal_length: Tensor, principal_point: Tensor, bend: Tensor
) -> Unprojection:
    xy = (pixels - principal_point) / focal_length
    squared = xy.square().sum(-1)
    root = 1 + squared * (1 - bend**2)
    z = (root.clamp_min(0).sqrt() - squared * bend) / (squared + 1)
    return Unprojection(torch.cat((xy * (bend + z)[..., None], z[..., None]), -1), root > 0)


class ParabolicCamera(Camera):
    """The camera of ``project_parabolic``."""

    model = "parabolic mirror"
    functions = project_parabolic, unproject_parabolic

    focal_length: Intrinsic = Intrinsic(2, above=0)
    principal_point: Intrinsic = Intrinsic(2)
    bend: Intrinsic = Intrinsic()
    image_size: ImageSize = ImageSize()
    max_angle: MaxAngle = MaxAngle()


fitted(ParabolicCamera, shape_grid((0.8, 1.0, 1.2)))


@pytest.fixture
def unregistered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The registry as it was, afterwards."""
    MODELS.names()  # all of the package's own are imported
    monkeypatch.setattr(MODELS, "things", dict(MODELS.things))


def own_camera() -> ParabolicCamera:
    return ParabolicCamera([90.0, 91.0], [99.5, 79.5], 1.1, (160, 200), 1.4)


@pytest.mark.usefixtures("unregistered")
def test_a_registered_camera_is_written_read_back_and_converted_to(tmp_path: Path) -> None:
    assert register_camera(ParabolicCamera) is ParabolicCamera
    assert register_camera(ParabolicCamera) is ParabolicCamera, "twice is no mistake"
    rig = CameraRig(
        [own_camera(), PinholeCamera([50.0, 50.0], [9.5, 9.5], (20, 20))], torch.eye(4).repeat(2, 1, 1)
    )
    rig.to_yaml(tmp_path / "rig.yaml")
    again = read_rig(tmp_path / "rig.yaml")
    for name, camera in rig.cameras.items():
        assert again.cameras[name].equals(camera)
    save_camera(own_camera(), tmp_path / "camera.yaml")
    assert read_camera(tmp_path / "camera.yaml").equals(own_camera())
    stereographic = FisheyeCamera("stereographic", [45.0, 45.0], [99.5, 79.5], (160, 200), 1.4).to(
        torch.float64
    )
    conversion = convert(stereographic, to="parabolic mirror")
    assert conversion.max_error < 1e-6
    assert conversion.camera.bend.item() == pytest.approx(1.0)


def test_an_unregistered_camera_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    rig = CameraRig([own_camera()], torch.eye(4)[None])
    with pytest.raises(ArgumentError, match=r"ParabolicCamera could not be read back.*register_camera"):
        rig.to_yaml(tmp_path / "rig.yaml")
    with pytest.raises(ArgumentError, match="'parabolic mirror' is not known"):
        save_camera(own_camera(), tmp_path / "camera.yaml")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "camera.yaml").write_text(
        "format: sphericalvision-camera\nversion: 1\nmodel: parabolic mirror\n"
    )
    with pytest.raises(
        FileFormatError, match=r"model: expected one of angle_polynomial, atan, .*got 'parabolic mirror'"
    ):
        read_camera(tmp_path / "camera.yaml")
    with pytest.raises(
        ArgumentError, match=r"to: expected one of .*'brown_conrady'.* got 'parabolic mirror'"
    ):
        convert(own_camera(), "parabolic mirror")


def test_a_subclass_that_keeps_its_parents_name_is_refused(tmp_path: Path) -> None:
    class Periscope(PinholeCamera):
        """A pinhole of its own."""

    with pytest.raises(ArgumentError, match=r"Periscope.*'pinhole' is PinholeCamera's name"):
        save_camera(Periscope([1.0, 1.0], [0.0, 0.0], (4, 4)), tmp_path / "camera.yaml")


@pytest.mark.usefixtures("unregistered")
def test_installed_packages_offer_cameras_as_entry_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "mirrors-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mirrors\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        f"[sphericalvision.cameras]\nparabolic mirror = {__name__}:ParabolicCamera\nwrong = math:pi\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "parabolic mirror" in metadata.entry_points(group="sphericalvision.cameras").names
    save_camera(own_camera(), tmp_path / "camera.yaml")
    assert read_camera(tmp_path / "camera.yaml").equals(own_camera())
    with pytest.raises(ArgumentError, match=r"subclass of Camera .*'wrong'.*entry point math:pi"):
        convert(own_camera(), "wrong")
    assert math.isclose(convert(own_camera(), ParabolicCamera).max_error, 0.0, abs_tol=1e-3)
