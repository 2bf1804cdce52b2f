# SPDX-License-Identifier: Apache-2.0
"""What was seen travels with the values through every transform, data set and batch, and is never guessed from them."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.data import (
    Compose,
    OmniStereoDataset,
    PhotometricAugmentation,
    RandomShift,
    RandomSphereRotation,
    RandomYaw,
    RotateFisheye,
    RotateFivefold,
    SampleView,
    ToSphere,
    collate_samples,
    write_omnistereo,
)
from sphericalvision.data.augmentation.sphere_rotation import rotate_on_sphere
from sphericalvision.data.collate import Sample
from sphericalvision.data.sample_view import ToView
from sphericalvision.icosphere import Icosphere
from sphericalvision.sphere.intake import pixels_seen
from tests.worlds import scenes

LEVEL = 4


@pytest.fixture
def masked() -> CameraRig:
    """Four cameras of 220°, the first of which has a mask that takes a quarter of its image away."""
    rig = ring_rig(image_size=(48, 48))
    mask = torch.ones(48, 48, dtype=torch.bool)
    mask[12:, 28:] = False
    return CameraRig(rig.cameras, rig.world_from_camera, {"cam1": mask})


def sphere_sample(rig: CameraRig, values: Callable[[Tensor], Tensor] = torch.zeros_like) -> Sample:
    """A sample on the icosphere whose images are ``values`` of what was seen, 1 or 0; mid-grey if not given."""
    seen = ToSphere(LEVEL).seen(rig)
    images = values(seen.float())[:, None].expand(-1, 3, -1).clone()
    return {"images": images, "seen": seen, "rig": rig}


def by_angle(rig: CameraRig, directions: Tensor, margin: float) -> Tensor:
    """Which directions lie within 110° less a margin of the cameras' axes ``(n, V)``, by its own arithmetic."""
    angle = torch.acos((rig.axes.double() @ directions.double().T).clamp(-1, 1))
    return angle < math.radians(110) - margin


TURNS = {
    "fivefold": lambda: RotateFivefold(steps=2),
    "yaw on the grid": lambda: RandomYaw(Icosphere(LEVEL), same_on_batch=True),
    "any yaw": lambda: RandomYaw(Icosphere(LEVEL), angles="any", same_on_batch=True),
    "any rotation": lambda: RandomSphereRotation(Icosphere(LEVEL), same_on_batch=True),
}


@pytest.mark.parametrize("name", TURNS)
def test_seen_moves_with_the_values(name: str, masked: CameraRig) -> None:
    """Values that are 1 where something was seen: 1 wherever the result says so, and 0 elsewhere."""
    torch.manual_seed(3)
    turned = TURNS[name]()(sphere_sample(masked, lambda seen: seen))
    seen = turned["seen"]
    assert seen.dtype == torch.bool
    assert 0.3 < seen.double().mean() < 0.7
    assert not torch.equal(seen, ToSphere(LEVEL).seen(masked))
    assert turned["images"][:, 0][seen].min() > 0.998
    assert (turned["images"][:, 0][~seen] == 0).all()


@pytest.mark.parametrize("name", TURNS)
def test_seen_is_what_the_turned_rig_sees(name: str, masked: CameraRig) -> None:
    """Up to the vertices around the borders of fields of view and masks."""
    torch.manual_seed(4)
    turned = TURNS[name]()(sphere_sample(masked))
    expected = ToSphere(LEVEL).seen(turned["rig"])
    border = 0.06  # of an icosphere of level 4 one ring of vertices
    assert (turned["seen"] == expected).double().mean() > 1 - border
    first = turned["rig"].names.index("cam1")
    others = [k for k in range(4) if k != first]  # have no mask
    inner, outer = (by_angle(turned["rig"], Icosphere(LEVEL).vertices, m)[others] for m in (0.15, -0.05))
    assert turned["seen"][others][inner].all()
    assert not turned["seen"][others][~outer].any()


def test_interpolation_shows_nothing_of_what_was_not_seen(masked: CameraRig) -> None:
    """Bright where nothing was seen: no vertex that counts as seen has any of it."""
    grid = Icosphere(LEVEL)
    sample = sphere_sample(masked, lambda seen: 100 * (1 - seen))
    augment = RandomSphereRotation(grid, same_on_batch=True)
    turned = augment(sample)
    assert turned["images"].abs().max() < 0.2  # a thousandth of the weights at most
    turn = augment._params["rotation"][0]
    assert torch.equal(turned["seen"], rotate_on_sphere(sample["seen"], grid, turn, "seen"))


@pytest.mark.parametrize("entry", ["images", "fisheye"])
def test_colours_change_where_something_was_seen_and_nowhere_else(entry: str, masked: CameraRig) -> None:
    seen = ToSphere(LEVEL).seen(masked) if entry == "images" else torch.stack([*pixels_seen(masked).values()])
    grey = torch.zeros(4, 3, *seen.shape[1:])
    key = {"images": "seen", "fisheye": "fisheye_seen"}[entry]
    augment = PhotometricAugmentation(noise=0.0, generator=torch.Generator().manual_seed(1))
    changed = augment({entry: grey, key: seen})
    assert changed[key] is seen
    assert (changed[entry].movedim(1, -1)[seen] != 0).all()
    assert (changed[entry].movedim(1, -1)[~seen] == 0).all()
    assert (augment({entry: grey})[entry] != 0).all()  # without the entry, everything was seen


def test_turned_cameras_have_seen_what_their_new_masks_say(masked: CameraRig) -> None:
    images = {name: torch.full((3, 48, 48), 0.5) for name in masked.names}
    turned = RotateFisheye(tilt=0.6)({"images": images, "seen": pixels_seen(masked), "rig": masked})
    for name, seen in turned["seen"].items():
        assert torch.equal(seen, turned["rig"].masks[name])
        assert (turned["images"][name][:, seen] - 0.5).abs().max() < 1e-4
        assert (turned["images"][name][:, ~seen] == 0).all()
        assert 0 < seen.sum() < pixels_seen(masked)[name].sum()


def test_on_the_sphere_a_pixel_that_a_mask_covers_plays_no_part(masked: CameraRig) -> None:
    clean = {name: torch.full((3, 48, 48), 0.5) for name in masked.names}
    spoiled = {name: torch.where(pixels_seen(masked)[name], image, 100.0) for name, image in clean.items()}
    to_sphere = ToSphere(LEVEL)
    seen = to_sphere.seen(masked)
    inner = seen & by_angle(masked, Icosphere(LEVEL).vertices, 0.2)
    assert to_sphere.images(spoiled, masked).movedim(1, -1)[inner].abs().max() < 0.3
    assert to_sphere.images(clean, masked).abs().max() < 1e-5  # mid-grey, seen or not: values do not tell
    plain = to_sphere.seen(CameraRig(masked.cameras, masked.world_from_camera))
    assert (plain[0] & ~seen[0]).double().mean() > 0.1
    assert torch.equal(plain[1:], seen[1:])


def test_a_view_of_another_rig_is_that_rigs(masked: CameraRig) -> None:
    to_view, images = (
        ToView(SampleView(LEVEL, images=True)),
        {name: torch.rand(3, 48, 48) for name in masked.names},
    )
    for rig in (masked, CameraRig(masked.cameras, masked.world_from_camera)):
        entries = to_view.images(images, rig)
        assert torch.equal(entries["fisheye_seen"], torch.stack([*pixels_seen(rig).values()]))
        assert torch.equal(entries["seen"], ToSphere(LEVEL).seen(rig))


def test_rendered_scenes_say_what_was_seen(masked: CameraRig, tmp_path: Path) -> None:
    vertices = Icosphere(LEVEL).vertices
    for data in (
        scenes(masked, view=SampleView(LEVEL)),
        scenes(masked, view=SampleView(LEVEL, images=True), cache_dir=tmp_path),
        scenes(masked, view=SampleView(LEVEL, images=True), cache_dir=tmp_path),
    ):
        sample = data[0]
        assert torch.equal(sample["seen"], ToSphere(LEVEL).seen(masked))
        assert sample["seen"][1:][by_angle(masked, vertices, 0.05)[1:]].all()
        assert (sample["images"].movedim(1, -1)[~sample["seen"]] == 0).all()
        if "fisheye" in sample:
            assert torch.equal(sample["fisheye_seen"], torch.stack([*pixels_seen(masked).values()]))
            assert (sample["fisheye"].movedim(1, -1)[~sample["fisheye_seen"]] == 0).all()


def test_sets_on_disk_say_what_was_seen(
    tmp_path: Path, rig: CameraRig, frames: Callable[..., list[Sample]]
) -> None:
    write_omnistereo(tmp_path, frames(1, 2), rig)
    data = OmniStereoDataset(tmp_path, split="all")
    sample = data[0]
    assert list(sample["seen"]) == list(sample["images"])
    for name, camera in data.rig.cameras.items():
        assert torch.equal(sample["seen"][name], camera.unproject(camera.pixel_grid()).valid)
    assert "seen" not in ToView(SampleView(depth_level=2, images=True))(sample)  # which has its fisheye_seen
    turns = RotateFisheye(tilt=0.3), ToSphere(3), RotateFivefold()
    stages = Compose(PhotometricAugmentation(), RandomShift(), *turns)
    through = OmniStereoDataset(tmp_path, split="all", transform=stages)
    batch = collate_samples([through[0], through[1]])
    assert batch["seen"].shape == (2, 4, 642)
    assert batch["seen"].dtype == torch.bool
    assert (batch["images"].movedim(2, -1)[~batch["seen"]] == 0).all()
    noise = (batch["images"].movedim(2, -1)[batch["seen"]] != 0).any(-1)
    assert noise.double().mean() > 0.99  # it is not grey
