# SPDX-License-Identifier: Apache-2.0
"""Images from one camera to another: identity, OpenCV, scenes in closed form, seams, masks, modes, derivatives."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import (
    Camera,
    EquirectangularCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    PinholeCamera,
    Remap,
    depth_from_z,
    remap,
    remap_mask,
    undistort,
    undistorted_camera,
    z_from_depth,
)
from sphericalvision.cameras.remapping.area import block_means
from sphericalvision.cameras.remapping.remap import REMAP_MODES
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.kernels import reference_kernels
from tests.laws.camera_laws import circle

FISHEYE = FisheyeCamera.from_field_of_view((72, 96), math.radians(200)).to(torch.float64)
PINHOLE = PinholeCamera([50.0, 50.0], [39.5, 29.5], (60, 80)).to(torch.float64)
PANORAMA = EquirectangularCamera((32, 64)).to(torch.float64)
CAMERAS = pytest.mark.parametrize("camera", [FISHEYE, PINHOLE, PANORAMA], ids=lambda camera: camera.model)
MODES = pytest.mark.parametrize("mode", REMAP_MODES)


def turn(x: float, y: float, z: float) -> Tensor:
    vector = torch.tensor([x, y, z], dtype=torch.float64)
    return transform_from_axis_angle(vector, torch.zeros(3, dtype=torch.float64))[:3, :3]


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) + 0.5


def directions_of(camera: Camera) -> Tensor:
    return camera.unproject(camera.pixel_grid(torch.float64)).directions


def scene(d: Tensor) -> Tensor:
    """Three colours that vary slowly with the direction."""
    x, y, z = d.unbind(-1)
    return torch.stack((torch.sin(2 * x + 0.5) * y + z * z, torch.cos(2 * y - z), x * z + 0.3 * y))


def both(
    image: Tensor,
    source: Camera,
    target: Camera,
    rotation: Tensor | None = None,
    mode: str = "bilinear",
    fill: float = 0.0,
    mask: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Values (*b, c, h, w) and where they are valid (*b, h, w)."""
    values, usable = remap(image, source, target, rotation, mode, fill, mask), mask
    if mode == "depth":
        known = (image > 0).all(-3)
        usable = known if mask is None else known & (mask != 0)
    valid = remap_mask(source, target, rotation, mode, usable)
    return values, valid.expand(*values.shape[:-3], *valid.shape[-2:])


def inner(mask: Tensor, by: int = 1) -> Tensor:
    """Pixels whose neighbours are in the mask too."""
    outside = torch.nn.functional.max_pool2d((~mask).double()[None], 2 * by + 1, 1, by)[0]
    return mask & (outside == 0)


# Laws -----------------------------------------------------------------------------------------------------------------


@CAMERAS
@MODES
def test_onto_itself_is_the_identity(camera: Camera, mode: str) -> None:
    image = noise(2, 3, *camera.image_size)
    values, valid = both(image, camera, camera, mode=mode)
    seen = camera.unproject(camera.pixel_grid()).valid
    assert torch.equal(valid, seen.expand(2, *camera.image_size))
    torch.testing.assert_close(values[..., seen], image[..., seen], rtol=0, atol=1e-12)
    assert (values[..., ~seen] == 0).all()


@MODES
def test_constants_stay_constant(mode: str) -> None:
    """Every kernel's weights add up to one, at the borders, the seam, the poles and the rim too."""
    for source in (FISHEYE, PINHOLE, PANORAMA):
        for target in (FISHEYE, PINHOLE, PANORAMA):
            for dtype, bound in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
                image = torch.full((1, *source.image_size), 3.0, dtype=dtype)
                values, valid = both(image, source, target, turn(0.3, 0.8, -0.2), mode, fill=-1.0)
                assert valid.any()
                assert (values[0][valid] - 3).abs().max() <= bound, (source, target, dtype)
                assert (values[0][~valid] == -1).all()


@MODES
@pytest.mark.parametrize("fill", [0.0, -2.5, math.nan])
def test_module_and_function_agree(mode: str, fill: float) -> None:
    rotation = turn(0.1, 0.4, 0.2)
    image = noise(2, 3, *PANORAMA.image_size)
    module = Remap(PANORAMA, FISHEYE, rotation, mode=mode, fill=fill, dtype=torch.float64)
    expected = remap(image, PANORAMA, FISHEYE, rotation, mode, fill)
    torch.testing.assert_close(module(image), expected, rtol=0, atol=1e-12, equal_nan=True)
    assert torch.equal(module.mask(), remap_mask(PANORAMA, FISHEYE, rotation, mode))
    assert not module.state_dict()
    assert not list(module.parameters())


def test_turning_there_and_back() -> None:
    """A panorama that is turned by whole columns rolls, whatever is at the seam."""
    image = noise(1, *PANORAMA.image_size)
    for mode in REMAP_MODES:
        values, valid = both(image, PANORAMA, PANORAMA, turn(0, 5 * 2 * math.pi / 64, 0), mode)
        assert valid.all()
        torch.testing.assert_close(values, image.roll(5, -1), rtol=0, atol=1e-11)


@pytest.mark.parametrize("mode", ["bilinear", "area", "bicubic", "depth"])
def test_a_scene_looks_the_same_through_every_pair(mode: str) -> None:
    """What is seen depends on the direction only: remapped or taken directly, up to interpolation."""
    rotation = turn(0.2, 0.5, -0.1)
    cameras = (
        FisheyeCamera.from_field_of_view((144, 192), math.radians(200)).to(torch.float64),
        PinholeCamera([120.0, 120.0], [99.5, 79.5], (160, 200)).to(torch.float64),
        EquirectangularCamera((96, 192)).to(torch.float64),
    )
    for source in cameras:
        for target in cameras:
            image = scene(directions_of(source)) + 3
            expected = scene(directions_of(target) @ rotation) + 3
            values, valid = both(image, source, target, rotation, mode)
            if isinstance(source, FisheyeCamera):  # its formula goes on beyond the image circle, bent
                valid = inner(valid, 2)
            assert (values - expected)[:, valid].abs().max() < (3e-2 if mode == "area" else 1e-2)
            assert (values - expected)[:, valid].square().mean().sqrt() < 2e-3


def test_batches_of_images_cameras_and_rotations_broadcast() -> None:
    first = FisheyeCamera("equidistant", 20.0, [47.5, 35.5], (72, 96), 1.6).to(torch.float64)
    second = FisheyeCamera("equidistant", 25.0, [45.0, 36.0], (72, 96), 1.6).to(torch.float64)
    source = FisheyeCamera.stack([first, second])
    rotations = torch.stack([turn(0, a, 0) for a in (0.0, 0.5, 1.0)]).unsqueeze(1)
    image = noise(2, 1, 72, 96)
    for mode in ("bilinear", "area", "nearest"):
        values, valid = both(image, source, PANORAMA, rotations, mode)
        assert values.shape == (3, 2, 1, 32, 64)
        assert valid.shape == (3, 2, 32, 64)
        alone, seen = both(image[1], second, PANORAMA, rotations[2, 0], mode)
        if mode == "area":  # a batch shares its samples, of which a lone camera needs fewer
            assert (values[2, 1] - alone)[:, seen & valid[2, 1]].abs().mean() < 0.05
        else:
            assert torch.equal(valid[2, 1], seen)
            torch.testing.assert_close(values[2, 1], alone, rtol=0, atol=1e-12)
    panoramas = noise(3, 1, 1, 32, 64)  # from one camera to two, across the seam
    values, _ = both(panoramas, PANORAMA, source, rotations)
    alone, _ = both(panoramas[2, 0], PANORAMA, second, rotations[2, 0])
    torch.testing.assert_close(values[2, 1], alone, rtol=0, atol=1e-12)


# Oracles --------------------------------------------------------------------------------------------------------------


def test_opencv_fisheye_to_pinhole() -> None:
    size, distortion = (150, 200), [-0.02, 0.01, -0.004, 0.001]
    matrix = np.array([[90.0, 0, 101.3], [0, 92.0, 73.8], [0, 0, 1]])
    camera = KannalaBrandtCamera([90.0, 92.0], [101.3, 73.8], distortion, size, math.radians(80)).to(
        torch.float64
    )
    target = PinholeCamera([70.0, 75.0], [60.2, 44.0], (90, 120)).to(torch.float64)
    rotation = turn(0.1, -0.3, 0.05)
    new_matrix = np.array([[70.0, 0, 60.2], [0, 75.0, 44.0], [0, 0, 1]])
    maps = cv2.fisheye.initUndistortRectifyMap(
        matrix, np.array(distortion), rotation.numpy(), new_matrix, (120, 90), cv2.CV_32FC1
    )
    image = noise(*size)
    expected = torch.from_numpy(cv2.remap(image.numpy(), *maps, cv2.INTER_NEAREST))
    values, valid = both(image[None], camera, target, rotation, "nearest")
    ties = 0.02  # OpenCV rounds maps to float32
    assert valid.double().mean() > 0.9
    assert ((values[0] - expected).abs()[inner(valid)] > 0).double().mean() < ties
    smooth = scene(directions_of(camera))[0]
    expected = torch.from_numpy(cv2.remap(smooth.numpy(), *maps, cv2.INTER_LINEAR))
    values, valid = both(smooth[None], camera, target, rotation)
    # 1/32 pixel there
    torch.testing.assert_close(values[0][inner(valid)], expected[inner(valid)], rtol=0, atol=1e-3)


def test_opencv_bicubic_has_the_same_kernel() -> None:
    """Keys' cubic with a = -0.75; OpenCV rounds positions to 1/32 pixel, which are exact here."""
    image = noise(40, 50)
    source = PinholeCamera([30.0, 30.0], [24.5, 19.5], (40, 50)).to(torch.float64)
    target = PinholeCamera([30.0, 30.0], [24.25, 19.875], (40, 50)).to(torch.float64)
    u, v = np.meshgrid(np.arange(50) + 4.25, np.arange(40) + 3.625)
    padded = np.pad(image.numpy(), 4, mode="edge")  # the border's pixels repeated
    expected = cv2.remap(padded, u.astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC)
    values, valid = both(image[None], source, target, mode="bicubic")
    torch.testing.assert_close(values[0][valid], torch.from_numpy(expected)[valid], rtol=0, atol=1e-5)
    assert valid.double().mean() > 0.97


def brute_force(image: Tensor, source: Camera, target: Camera, rotation: Tensor, side: int = 16) -> Tensor:
    """Means over ``side`` x ``side`` bilinear samples in every target pixel."""
    offsets = (torch.arange(side, dtype=torch.float64) + 0.5) / side - 0.5
    total, count = torch.zeros(()), torch.zeros(())
    for v in offsets:
        shifts = torch.stack((offsets[:, None, None], v.expand(side, 1, 1)), -1)
        rays = target.unproject((target.pixel_grid() + shifts).flatten(0, 2))
        values, seen = source.sample(image, rays.directions @ rotation)
        seen = (seen & rays.valid).view(side, *target.image_size)
        total = total + (values.view(-1, *seen.shape) * seen).sum(1)
        count = count + seen.sum(0)
    return total / count


PATTERNS = {
    "stripes": (60, lambda u, v: torch.sin(2 * math.pi * u / 2.3)),
    "checkerboard": (150, lambda u, v: ((u + v) % 2) * 2 - 1),
    "noise": (500, lambda u, v: 2 * noise(*u.shape) - 2),
}
"""How many times less energy is aliased than by bilinear lookups, and values of pixels."""


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("shrink", [4, 8])
def test_area_is_the_mean_over_what_a_pixel_covers(shrink: int, pattern: str) -> None:
    """Against 256 samples a pixel: far less aliased energy than bilinear, and no bias."""
    times, values = PATTERNS[pattern]
    source = FisheyeCamera.from_field_of_view((256, 256), math.radians(190)).to(torch.float64)
    size = 256 // shrink
    target = FisheyeCamera.from_field_of_view((size, size), math.radians(180), "stereographic").to(
        torch.float64
    )
    rotation = turn(0.02, 0.03, 0.4)
    image = values(*source.pixel_grid().unbind(-1))[None]
    expected = brute_force(image, source, target, rotation)
    area, valid = both(image, source, target, rotation, "area")
    bilinear, _ = both(image, source, target, rotation)
    valid = inner(valid, 1)
    wrong, aliased = ((x - expected)[:, valid].square().mean() for x in (area, bilinear))
    assert aliased > 0.02
    assert wrong < aliased / times
    assert (area - expected)[:, valid].mean().abs() < 2e-3


@pytest.mark.parametrize("size", [(12, 18), (13, 19), (2, 3)])
def test_means_over_blocks_are_those_of_torch(size: tuple[int, int]) -> None:
    image = noise(2, 3, *size).requires_grad_()
    for side in (2, 5):
        with reference_kernels():
            expected = block_means(image, side)
            (slope,) = torch.autograd.grad(expected.square().sum(), image)
            of_bytes = block_means((100 * image).byte(), side)
        found = block_means(image, side)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-14)
        torch.testing.assert_close(torch.autograd.grad(found.square().sum(), image)[0], slope)
        torch.testing.assert_close(block_means((100 * image).byte(), side), of_bytes)
        half = block_means(image.half(), side)
        assert half.dtype == torch.float16
        torch.testing.assert_close(half.double(), expected, rtol=0, atol=1e-3)


def test_area_is_bilinear_where_the_image_grows() -> None:
    target = PinholeCamera([300.0, 300.0], [39.5, 29.5], (60, 80)).to(torch.float64)
    image = noise(1, *FISHEYE.image_size)
    area, valid = both(image, FISHEYE, target, mode="area")
    assert valid.all()
    assert torch.equal(area, remap(image, FISHEYE, target))


def test_area_at_the_pole_and_the_seam_of_a_panorama() -> None:
    """Rows near a pole hold far more pixels than content: they must not blur it."""
    source = EquirectangularCamera((256, 512)).to(torch.float64)
    image = scene(directions_of(source))
    target = PinholeCamera([16.0, 16.0], [15.5, 15.5], (32, 32)).to(torch.float64)
    for rotation in (turn(-math.pi / 2, 0, 0), turn(math.pi / 2, 0, 0), turn(0, math.pi, 0)):
        expected = brute_force(image, source, target, rotation, 8)
        area, valid = both(image, source, target, rotation, "area")
        assert valid.all()
        torch.testing.assert_close(area, expected, rtol=0, atol=2e-3)


@pytest.mark.parametrize(("first", "last"), [(0, 64), (32, 160), (128, 256)])
def test_a_part_of_a_panorama_is_averaged_as_the_whole(first: int, last: int) -> None:
    whole = EquirectangularCamera((256, 512)).to(torch.float64)
    part = whole.cropped(first, 0, last - first, 512)
    target = PinholeCamera([60.0, 60.0], [11.5, 11.5], (24, 24)).to(torch.float64)
    rotation = turn(((first + last) / 2 - 128) / 256 * math.pi, 0, 0)
    image = noise(1, 256, 512)
    expected, _ = both(image, whole, target, rotation, "area")
    area, valid = both(image[:, first:last], part, target, rotation, "area")
    assert valid.all()
    torch.testing.assert_close(area, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("size", [(32, 64), (31, 63)])
def test_seam_and_poles_of_a_panorama(size: tuple[int, int]) -> None:
    """Interpolation goes on across the edges: no trace of them in a view that has them in its middle."""
    source = EquirectangularCamera(size).to(torch.float64)
    image = scene(directions_of(source))
    target = PinholeCamera([60.0, 60.0], [39.5, 39.5], (80, 80)).to(torch.float64)
    for rotation in (turn(0, math.pi, 0), turn(-math.pi / 2, 0, 0), turn(math.pi / 2, 0, 0)):
        expected = scene(directions_of(target) @ rotation)
        for mode, bound in (("bilinear", 1.5e-2), ("bicubic", 1.2e-2), ("area", 1.5e-2)):
            values, valid = both(image, source, target, rotation, mode)
            assert valid.all()
            assert (values - expected).abs().max() < bound, mode


def test_a_panorama_without_poles_ends_at_its_edges() -> None:
    """Its first row goes on unchanged for half a pixel; what is behind the camera has no part in it."""
    source = EquirectangularCamera((16, 64), math.pi / 2).to(torch.float64)
    target = EquirectangularCamera((32, 64), math.pi / 2).to(torch.float64)
    image = noise(1, 16, 64)
    for mode in REMAP_MODES:
        values, valid = both(image, source, target, mode=mode)
        assert valid.all()
        if mode != "bicubic":
            torch.testing.assert_close(values[0, [0, -1]], image[0, [0, -1]], rtol=0, atol=1e-12)
    _, valid = both(image, source, PANORAMA)
    assert torch.equal(valid.any(1), valid.all(1))
    assert valid.double().mean() == 0.5


# Labels, depth, masks -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int64, torch.bool, torch.float32])
def test_labels_keep_their_set_and_type(dtype: torch.dtype) -> None:
    labels = torch.tensor([0, 7, 40, 200 if dtype != torch.int16 else 300])
    image = labels[
        torch.randint(4, (2, 1, *FISHEYE.image_size), generator=torch.Generator().manual_seed(0))
    ].to(dtype)
    module = Remap(FISHEYE, PANORAMA, turn(0.1, 0.2, 0.3), "nearest", fill=1.0)
    values, valid = module(image), module.mask().expand(2, -1, -1)
    assert values.dtype == dtype
    assert set(values[:, 0][valid].unique().tolist()) <= set(image.unique().tolist())
    assert (values[:, 0][~valid] == 1).all()
    assert (~valid).any()
    floats = module(image.to(torch.float64))
    assert torch.equal(values.to(torch.float64), floats)


def test_nearest_is_the_nearest_pixel() -> None:
    index = torch.arange(32 * 64).view(1, 32, 64)
    pixels, _ = PANORAMA.project(directions_of(FISHEYE) @ turn(0.1, 2.0, 0.3))
    column, row = (pixels + 0.5).floor().long().unbind(-1)
    expected = row.clamp(0, 31) * 64 + column % 64
    values, valid = both(index, PANORAMA, FISHEYE, turn(0.1, 2.0, 0.3), "nearest", fill=-1)
    assert torch.equal(values[0][valid], expected[valid])


def test_depth_of_a_plane_stays_exact_and_unknown_pixels_take_no_part() -> None:
    """Depth along the rays needs no change under rotation; its inverse is linear in the direction on a plane."""
    source = PinholeCamera([200.0, 200.0], [159.5, 119.5], (240, 320)).to(torch.float64)
    normal = torch.nn.functional.normalize(torch.tensor([0.1, 0.2, -1.0], dtype=torch.float64), dim=0)
    depth = -2.0 / (directions_of(source) @ normal)
    holes = noise(240, 320) < 0.7
    damaged = torch.where(holes, torch.tensor([0.0, math.nan, -1.0])[torch.arange(320) % 3].double(), depth)
    rotation = turn(0.1, 0.2, 0.3)
    expected = -2.0 / (directions_of(PINHOLE) @ rotation @ normal)
    values, valid = both(depth[None], source, PINHOLE, rotation, "depth")
    assert (values[0] / expected - 1).abs()[inner(valid, 5)].max() < 1e-5
    values, valid = both(damaged[None], source, PINHOLE, rotation, "depth", fill=math.nan)
    assert (values[0] / expected - 1).abs()[valid].max() < 5e-3
    assert 0.5 < valid.double().mean() < 1
    assert values[0][~valid].isnan().all()


def test_infinite_depth_stays_infinite() -> None:
    depth = torch.full((1, 72, 96), math.inf)
    depth[..., :48] = 2.0
    values, valid = both(depth, FISHEYE, PINHOLE, mode="depth")
    assert valid.all()
    assert not values.isnan().any()
    assert (values >= 2 - 1e-6).all()
    assert values.isinf().double().mean() > 0.4


def test_depth_along_rays_and_along_the_axis() -> None:
    z = torch.full((60, 80), 2.0, dtype=torch.float64)
    depth, valid = depth_from_z(z, PINHOLE)
    assert valid.all()
    v, u = 29, 60
    ray = PINHOLE.unproject(torch.tensor([60.0, 29.0], dtype=torch.float64)).directions
    torch.testing.assert_close(depth[v, u] * ray[2], z[v, u])
    torch.testing.assert_close(z_from_depth(depth, PINHOLE)[0], z)
    _, ahead = depth_from_z(torch.ones(72, 96), FISHEYE)
    _, seen = z_from_depth(torch.ones(72, 96), FISHEYE)
    assert seen.sum() > ahead.sum() > 0  # a 200° lens sees past 90°, where z says nothing


@pytest.mark.parametrize("mode", ["bilinear", "area", "nearest", "depth"])
def test_masked_pixels_take_no_part(mode: str) -> None:
    """Whatever is written there, NaN too, changes nothing; constants stay constant up to the mask's edge."""
    mask = noise(*FISHEYE.image_size) < 1.2
    image = torch.where(mask, 5.0, math.nan).double()[None]
    for target in (PINHOLE, PANORAMA, EquirectangularCamera((8, 16)).to(torch.float64)):
        module = Remap(FISHEYE, target, mode=mode, mask=mask, dtype=torch.float64)
        open_module = Remap(FISHEYE, target, mode=mode, dtype=torch.float64)
        known = (image[0] > 0) & mask if mode == "depth" else mask
        answers = (
            (module(image), module.mask(known)),
            both(image, FISHEYE, target, mode=mode, mask=mask.to(torch.uint8) * 255),
            (open_module(image, mask), open_module.mask(mask)),
        )
        for values, valid in answers:
            assert torch.equal(valid, answers[0][1])
            torch.testing.assert_close(values, 5.0 * valid[None].double(), rtol=0, atol=1e-12)
    _, valid = both(image, FISHEYE, FISHEYE, mode=mode, mask=mask)
    assert torch.equal(valid, mask & FISHEYE.unproject(FISHEYE.pixel_grid()).valid)


def test_valid_is_where_usable_pixels_are_touched() -> None:
    source = PinholeCamera([20.0, 20.0], [19.5, 19.5], (40, 40)).to(torch.float64)
    # Looks up 0.25 to the right
    target = PinholeCamera([20.0, 20.0], [19.25, 19.5], (40, 40)).to(torch.float64)
    mask = torch.zeros(40, 40, dtype=torch.bool)
    mask[:, 10] = True
    image = torch.arange(40.0).double().expand(1, 40, 40)
    values, valid = both(image, source, target, mask=mask)
    assert valid.any(0).nonzero().flatten().tolist() == [9, 10]
    torch.testing.assert_close(values[0, :, 9:11], torch.full((40, 2), 10.0, dtype=torch.float64))
    _, nearest = both(image, source, target, mode="nearest", mask=mask)
    assert nearest.any(0).nonzero().flatten().tolist() == [10]


# Undistort ------------------------------------------------------------------------------------------------------------


def test_undistort_is_remap_to_a_pinhole_camera() -> None:
    image = scene(directions_of(FISHEYE))
    rotation = turn(0.0, -0.6, 0.0)
    values = undistort(image, FISHEYE, math.radians(80), image_size=(60, 90), rotation=rotation)
    camera = undistorted_camera(FISHEYE, math.radians(80), image_size=(60, 90))
    edges = camera.unproject(torch.tensor([[-0.5, 29.5], [89.5, 29.5]], dtype=torch.float64)).directions
    torch.testing.assert_close(
        edges[0] @ edges[1], torch.tensor(math.cos(math.radians(80))).double(), rtol=0, atol=1e-7
    )
    assert remap_mask(FISHEYE, camera, rotation).all()
    assert (values - scene(directions_of(camera) @ rotation)).abs().max() < 1e-2


def test_undistort_keeps_the_scale_of_the_middle() -> None:
    camera = undistorted_camera(FISHEYE)
    torch.testing.assert_close(camera.focal_length, FISHEYE.focal_length.expand(2), rtol=1e-6, atol=0)
    assert camera.image_size == FISHEYE.image_size
    batch = FisheyeCamera.stack([FISHEYE, FISHEYE])
    assert undistort(noise(2, 1, 72, 96), batch, focal_length=40.0).shape == (2, 1, 72, 96)
    assert remap_mask(batch, undistorted_camera(batch, focal_length=40.0)).all()


@pytest.mark.parametrize("size", [(72, 96), (120, 60)])
@pytest.mark.parametrize("view", [110, 200])
def test_balance_goes_from_all_valid_to_all_kept(size: tuple[int, int], view: int) -> None:
    """Of a lens whose axis is not in the middle; each end is the limit: a hundredth beyond, it does not hold."""
    lens = FisheyeCamera("equidistant", [24.0, 24.0], [44.5, 37.0], (72, 96), math.radians(view / 2)).to(
        torch.float64
    )
    valid, middle, kept = (undistorted_camera(lens, balance=share, image_size=size) for share in (0, 0.5, 1))
    assert remap_mask(lens, valid).all()
    wider = undistorted_camera(lens, focal_length=0.98 * valid.focal_length[0], image_size=size)
    assert view == 200 or not remap_mask(lens, wider).all()
    angle = torch.linspace(0, math.radians(min(view / 2, 80)) * 0.999, 200, dtype=torch.float64)[:, None]
    azimuth = torch.linspace(0, 2 * math.pi, 360, dtype=torch.float64)
    directions = circle(angle, azimuth)
    asked = directions[lens.project(directions).valid]
    assert kept.project(asked).valid.all()
    narrower = undistorted_camera(lens, focal_length=1.03 * kept.focal_length[0], image_size=size)
    assert not narrower.project(asked).valid.all()
    expected = (valid.focal_length + kept.focal_length) / 2
    torch.testing.assert_close(middle.focal_length, expected)
    assert kept.focal_length[0] < valid.focal_length[0]
    image = noise(1, 3, 72, 96)
    torch.testing.assert_close(
        undistort(image, lens, balance=0.5, image_size=size), remap(image, lens, middle)
    )


# Derivatives, devices, compilers --------------------------------------------------------------------------------------


PATCH = PinholeCamera([2.1, 2.3], [1.9, 1.4], (3, 4)).to(torch.float64)
AHEAD, BEHIND = [0.1, 0.2, 0.3], [-0.6, 3.0, 0.1]
SOURCES = {
    "fisheye": (FisheyeCamera.from_field_of_view((9, 11), math.radians(200)).to(torch.float64), AHEAD),
    "across the seam": (EquirectangularCamera((6, 12)).to(torch.float64), BEHIND),
}


@pytest.mark.parametrize("mode", ["bilinear", "area", "bicubic", "depth"])
@pytest.mark.parametrize("name", SOURCES)
def test_gradients(name: str, mode: str) -> None:
    """By image, rotation and the intrinsics of both cameras."""
    source, start = SOURCES[name]
    intrinsics = [getattr(camera, key) for camera in (source, PATCH) for key in camera.intrinsic_names[:1]]
    leaves = [noise(1, *source.image_size), torch.tensor(start).double(), *intrinsics]

    def function(image: Tensor, angles: Tensor, *focal: Tensor) -> Tensor:
        taken = source.with_intrinsics(focal_length=focal[0]) if len(focal) > 1 else source
        rotation = transform_from_axis_angle(angles, torch.zeros(3, dtype=torch.float64))[:3, :3]
        return remap(image, taken, PATCH.with_intrinsics(focal_length=focal[-1]), rotation, mode)

    inputs = tuple(leaf.detach().clone().requires_grad_() for leaf in leaves)
    assert torch.autograd.gradcheck(function, inputs, fast_mode=True)


@MODES
def test_gradients_are_finite_where_nothing_is_seen(mode: str) -> None:
    image = torch.rand(1, *PINHOLE.image_size).requires_grad_()
    rotation = turn(0.0, 2.0, 0.0).float().requires_grad_()
    values = remap(image, PINHOLE, FISHEYE, rotation, mode)
    assert not remap_mask(PINHOLE, FISHEYE, rotation, mode).all()
    values.sum().backward()
    assert image.grad is not None
    assert image.grad.isfinite().all()
    assert mode == "nearest" or (rotation.grad is not None and rotation.grad.isfinite().all())


def test_module_follows_to_and_takes_every_float() -> None:
    module = Remap(PANORAMA, PINHOLE, turn(0, 3.0, 0), fill=0.25)
    assert module(torch.rand(3, 32, 64)).dtype == torch.float32
    assert module(torch.rand(3, 32, 64).half()).dtype == torch.float16
    assert module(torch.rand(3, 32, 64).double()).dtype == torch.float64
    image = noise(2, 3, 32, 64)
    expected = remap(image, PANORAMA, PINHOLE, turn(0, 3.0, 0), fill=0.25)
    channels_last = image.to(memory_format=torch.channels_last)
    torch.testing.assert_close(module.double()(channels_last), expected, rtol=0, atol=1e-4)
    meta = module.to("meta")(torch.empty(3, 32, 64, device="meta", dtype=torch.float64))
    assert meta.device.type == "meta"
    assert meta.shape == (3, 60, 80)


@pytest.mark.slow
@MODES
def test_module_compiles_to_one_graph(mode: str) -> None:
    module = Remap(PANORAMA, PINHOLE, turn(0, 3.0, 0), mode)
    compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
    image = torch.rand(2, 3, 32, 64)
    torch.testing.assert_close(compiled(image), module(image))
