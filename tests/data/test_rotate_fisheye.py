# SPDX-License-Identifier: Apache-2.0
"""Images of turned cameras: against renderings of the turned rig, and what nobody saw stays unknown."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data import Compose, OmniStereoDataset, RotateFisheye, ToSphere, write_omnistereo
from sphericalvision.data.collate import Sample
from sphericalvision.scenes import make_scene, render_rig
from tests.worlds import frames_of_noise

TILT = math.radians(35)


@pytest.fixture(scope="module")
def scene() -> Any:
    return make_scene("room", 1)


@pytest.fixture
def sample(scene: Any) -> Sample:
    rig = ring_rig(image_size=(96, 96))
    return {"images": render_rig(scene, rig, 2), "rig": rig}


def original_angles(before: CameraRig, after: CameraRig, name: str) -> torch.Tensor:
    """Angle of every pixel of a turned camera from the axis that it had before, by its own arithmetic."""
    index, camera = before.names.index(name), after.cameras[name]
    rays = camera.unproject(camera.pixel_grid()).directions @ after.world_from_camera[index, :3, :3].T
    cosine = (rays.double() @ before.axes[index].double()).clamp(-1, 1)
    return torch.acos(cosine)


def test_turned_images_are_what_turned_cameras_see(scene: Any, sample: Sample) -> None:
    turned = RotateFisheye(tilt=TILT)(sample)
    rig = sample["rig"].rotated(tilt=TILT)
    torch.testing.assert_close(turned["rig"].world_from_camera, rig.world_from_camera)
    for name, expected in render_rig(scene, rig, 2).items():
        mask = turned["rig"].masks[name]
        gap = (turned["images"][name] - expected)[:, mask].abs()
        assert gap.median() < 0.02
        assert gap.mean() < 0.04
        assert (turned["images"][name][:, ~mask] == 0).all()


def test_what_was_out_of_view_is_masked(sample: Sample) -> None:
    turned = RotateFisheye(tilt=TILT)(sample)
    pixel = math.radians(220) / 96
    for name, mask in turned["rig"].masks.items():
        camera = turned["rig"].cameras[name]
        angle = original_angles(sample["rig"], turned["rig"], name)
        looks = camera.unproject(camera.pixel_grid()).valid
        assert mask[looks & (angle < math.radians(110) - pixel)].all()
        assert not mask[angle > math.radians(110) + pixel].any()
        assert not mask[~looks].any()


def test_no_turn_changes_nothing_and_two_undo_each_other(sample: Sample) -> None:
    still = RotateFisheye()(sample)
    back = RotateFisheye(tilt=-TILT)(RotateFisheye(tilt=TILT)(sample))
    torch.testing.assert_close(back["rig"].world_from_camera, sample["rig"].world_from_camera)
    for name, image in sample["images"].items():
        inside = still["rig"].masks[name]
        assert inside.float().mean() > 0.77  # a circle in its square, less the border
        torch.testing.assert_close(still["images"][name][:, inside], image[:, inside], rtol=0, atol=1e-4)
        both = back["rig"].masks[name]
        assert 0.4 < both.float().mean() < inside.float().mean()
        assert (back["images"][name] - image)[:, both].abs().mean() < 0.04


def test_a_rotation_is_in_the_cameras_frame(sample: Sample) -> None:
    cos, sin = math.cos(TILT), math.sin(TILT)
    down = torch.tensor([[1.0, 0.0, 0.0], [0.0, cos, sin], [0.0, -sin, cos]])
    by_angle, by_matrix = RotateFisheye(tilt=TILT)(sample), RotateFisheye(rotation=down)(sample)
    each = RotateFisheye(rotation=down.expand(4, 3, 3), tilt=torch.zeros(4))(sample)
    for name in sample["images"]:
        torch.testing.assert_close(by_angle["images"][name], by_matrix["images"][name], rtol=0, atol=1e-4)
        assert torch.equal(by_matrix["images"][name], each["images"][name])


def test_the_centre_stays(sample: Sample) -> None:
    rig, origin = sample["rig"], torch.tensor([4e5, 0.0, 5e6]).double()
    sample["rig"] = CameraRig(rig.cameras, rig.world_from_camera, around=["cam2"], origin=origin)
    turned = RotateFisheye(tilt=TILT)(sample)["rig"]
    assert torch.equal(turned.center, sample["rig"].center)
    assert torch.equal(turned.origin, origin)


def test_masks_of_the_cameras_turn_with_them(sample: Sample) -> None:
    rig = sample["rig"]
    mask = torch.ones(96, 96, dtype=torch.bool)
    mask[:, :48] = False
    masked = CameraRig(rig.cameras, rig.world_from_camera, {"cam1": mask})
    spoiled = {**sample["images"], "cam1": torch.where(mask, sample["images"]["cam1"], 100.0)}
    turn = RotateFisheye(tilt=TILT)
    turned = turn({"images": spoiled, "rig": masked})
    assert turned["images"]["cam1"].max() <= 1.0 + 1e-5  # nothing of what is masked gets in
    assert not turned["rig"].masks["cam1"][:, :46].any()
    unmasked = turn(sample)["rig"].masks["cam1"]
    assert unmasked[:, :46].any()  # another rig gets other tables
    assert torch.equal(turned["rig"].masks["cam1"][:, 50:], unmasked[:, 50:])


def test_images_of_another_size(scene: Any, sample: Sample) -> None:
    turned = RotateFisheye(tilt=TILT, image_size=(48, 40))(sample)
    assert turned["images"]["cam2"].shape == (3, 48, 40)
    assert turned["rig"].cameras["cam2"].image_size == (48, 40)
    expected = render_rig(scene, turned["rig"], 2)["cam2"]
    mask = turned["rig"].masks["cam2"]
    assert (turned["images"]["cam2"] - expected)[:, mask].abs().mean() < 0.04


def test_it_turns_sets_on_disk_before_the_icosphere(tmp_path: Path, rig: CameraRig) -> None:
    write_omnistereo(tmp_path, frames_of_noise(rig, [1, 2]), rig)
    turn = RotateFisheye(tilt=TILT)
    data = OmniStereoDataset(tmp_path, split="all", transform=Compose(turn, ToSphere(3)))
    first, second = data[0], data[1]
    assert first["rig"] is second["rig"]  # the tables of what follows are kept, too
    assert first["images"].shape == (4, 3, 642)
    plain = OmniStereoDataset(tmp_path, split="all", transform=ToSphere(3))[0]
    assert torch.equal(first["inverse_depth"], plain["inverse_depth"])
    seen = [s["seen"] for s in (first, plain)]
    assert not (seen[0] & ~seen[1]).any()  # a turned camera sees nothing that the camera did not
    assert seen[0].sum() < seen[1].sum()
