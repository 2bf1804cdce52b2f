# SPDX-License-Identifier: Apache-2.0
"""``Intake``: ranges, what is seen, and that a network's own is the one it asks for."""

from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.core import ArgumentError, ShapeError
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import SemiGlobalSweep
from sphericalvision.sphere.intake import Intake, as_photographs

MASK = torch.arange(32)[None].expand(28, 32) > 12
RIG = ring_rig(3, image_size=(28, 32))
MASKED = CameraRig(RIG.cameras, RIG.world_from_camera, {"cam2": MASK})


@pytest.mark.parametrize("grid", [Icosphere(3), None], ids=["sphere", "camera"])
def test_convention_images_are_in_minus_one_to_one_and_zero_where_not_seen(grid: Icosphere | None) -> None:
    intake = Intake(MASKED, grid)
    white = intake({name: torch.ones(3, 28, 32) for name in RIG.names})
    black = intake({name: torch.zeros(3, 28, 32) for name in RIG.names})
    seen = intake.seen[:, None].expand_as(white)
    torch.testing.assert_close(white, seen.float())
    torch.testing.assert_close(black, -seen.float())
    assert 0 < seen[1].sum() < seen[0].sum()


@pytest.mark.parametrize("grid", [Icosphere(3), None], ids=["sphere", "camera"])
def test_a_batch_is_its_images_one_by_one_in_the_order_of_the_rig(
    grid: Icosphere | None, generator: torch.Generator
) -> None:
    images = {name: torch.rand(2, 3, 28, 32, generator=generator) for name in reversed(RIG.names)}
    intake = Intake(RIG, grid)
    for frame, found in enumerate(intake(images)):
        assert torch.equal(found, intake({name: image[frame] for name, image in images.items()}))
    only_second = intake({name: (image * (name == "cam2"))[0] for name, image in images.items()})
    assert torch.equal(only_second[1], intake(images)[0, 1])


def test_bytes_are_shares_of_white(generator: torch.Generator) -> None:
    rig = ring_rig(2, image_size=(24, 24))
    images = {name: torch.randint(256, (3, 24, 24), generator=generator).byte() for name in rig.names}
    shares = {name: image / 255 for name, image in images.items()}
    for grid in (Icosphere(3), None):
        torch.testing.assert_close(Intake(rig, grid)(images), Intake(rig, grid)(shares))


@pytest.mark.parametrize("bits", [8, 16])
def test_whole_numbers_are_shares_of_the_greatest_of_their_type(bits: int) -> None:
    values = np.linspace(0, 2**bits - 1, 28 * 32 * 3).astype(f"uint{bits}").reshape(28, 32, 3)
    seen = as_photographs(dict.fromkeys(RIG.names, values), RIG)["cam1"]
    expected = torch.from_numpy(values / (2**bits - 1)).float().movedim(-1, 0)
    torch.testing.assert_close(seen, expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_layouts_of_arrays_and_of_tensors_are_one_image(channels: int, generator: torch.Generator) -> None:
    """Alpha is dropped, grey is all three colours; batches and images alone; a little beyond [0, 1] is rounding."""
    images = torch.rand(5, channels, 28, 32, generator=generator) * 1.02 - 0.01
    expected = images[:, :3].expand(5, 3, 28, 32)
    layouts = [images, images.movedim(1, -1), *([images[:, 0]] if channels == 1 else [])]
    for layout in layouts:
        for result, truth in (
            (as_photographs(dict.fromkeys(RIG.names, layout), RIG), expected),
            (as_photographs(dict.fromkeys(RIG.names, layout[2].numpy()), RIG), expected[2]),
        ):
            assert torch.equal(result["cam2"], truth)
    for outside in (-0.02, 1.02):
        with pytest.raises(ArgumentError, match="cam3"):
            as_photographs(dict.fromkeys(RIG.names, images) | {"cam3": images.clamp(max=0) + outside}, RIG)


@pytest.mark.parametrize("change", [lambda image: image[None][:0], Tensor.to_sparse])
def test_images_of_nothing_and_sparse_ones_are_refused_by_name(change: Callable[[Tensor], Tensor]) -> None:
    images = {name: torch.ones(3, 28, 32) for name in RIG.names}
    with pytest.raises((ArgumentError, ShapeError), match="cam2"):
        as_photographs(images | {"cam2": change(images["cam2"])}, RIG)


def test_a_network_says_which_it_takes() -> None:
    assert torch.equal(SemiGlobalSweep(4, 8, 0.5).intake(RIG).seen, Intake(RIG, Icosphere(4)).seen)


@pytest.mark.parametrize(
    "mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "YCbCr", "LAB", "HSV", "I", "F", "I;16"]
)
def test_pictures_of_pillow_are_their_colours_or_refused(mode: str) -> None:
    """What numpy sees of a palette or of CMYK are numbers, but no brightness."""
    ramp = np.linspace(0, 255, 16 * 16).reshape(16, 16)
    colours = Image.fromarray(np.stack((ramp, ramp[::-1], ramp.T), -1).astype(np.uint8))
    deep = {"I;16": np.uint16(ramp * 257), "F": np.float32(ramp / 255)}
    picture = Image.fromarray(deep[mode]) if mode in deep else colours.convert(mode)
    grey = torch.from_numpy(ramp / 255).float().expand(3, -1, -1)
    rgb = torch.from_numpy(np.array(picture.convert("RGB"))).movedim(-1, 0) / 255
    rig = ring_rig(2, image_size=(16, 16))
    refused = () if mode in ("L", "RGB", "RGBA", "F", "I;16") else (ArgumentError, ShapeError)
    with suppress(*refused):
        seen = as_photographs(dict.fromkeys(rig.names, picture), rig)["cam1"]
        torch.testing.assert_close(seen, grey if mode in deep else rgb, atol=1e-4, rtol=0)
