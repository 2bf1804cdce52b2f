# SPDX-License-Identifier: Apache-2.0
"""What is made of cameras, rigs and walks, with defaults, where nothing has symmetry: one number each."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from sphericalvision.cameras import (
    CameraRig,
    EquirectangularCamera,
    PinholeCamera,
    Trajectory,
    convert,
    rectified_pairs,
)
from sphericalvision.cameras.field_of_view import cap, field_of_view, focal_length_on_axis, visible_angle
from sphericalvision.cameras.remapping.lookup import pixels_a_radian
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.icosphere import icosphere_vertices
from tests.laws.cameras import CAMERAS, uneven_rig
from tests.values import numbers_in, rand, sum_of

RIG = uneven_rig()
A, B = RIG.cameras["a"], RIG.cameras["b"]
IMAGES = {name: rand(2, 36, 50, seed=k) for k, name in enumerate(RIG.names)}
MASK, DEEP = rand(2, 36, 50, seed=6) > 0.2, 3 * rand(36, 50, seed=7) - 0.2
RAYS = icosphere_vertices(2, torch.float64)
LENSES = {case.name: case.make(1.0).to(torch.float64) for case in CAMERAS}
NARROW = PinholeCamera([30.0, 33.0], [14.0, 9.5], (20, 27)).to(torch.float64)
WIDE = EquirectangularCamera((16, 32)).to(torch.float64)
TURN = transform_from_axis_angle(torch.tensor([0.2, -0.4, 0.3]), torch.tensor([0.4, 0.1, -0.2])).double()
FAR = CameraRig(RIG.cameras, RIG.world_from_camera, RIG.masks, ["a", "c"], 1000 * rand(3, seed=4))
WALK = Trajectory(
    [f"{k}.5" for k in range(7)], transform_from_axis_angle(rand(7, 3, seed=1) - 0.3, 4 * rand(7, 3, seed=2))
)


def converted(lens: str, to: str, **options: Any) -> Any:
    """Where the new lens shows directions, and how far off it is."""
    new, *errors = convert(LENSES[lens], to, **options)
    return new.project(cap(0.9 * errors[-1], 40, new)).pixels / 50, *errors


def pairs(kind: str, **options: Any) -> Any:
    """Everything of rectified pairs, of every third pixel."""
    for pair in rectified_pairs(RIG, kind, **options):
        shift = 3 * rand(*pair.image_size, seed=3)
        ways = [
            way(shift + more, of)
            for way, more in ((pair.distance, 0.0), (pair.disparity, 0.4))
            for of in (None, pair.names[1])
        ]
        fields = [field for way in ways for field in way] + [
            *pair.rectify(IMAGES),
            pair.upright(shift),
            *pair.seen,
        ]
        pixels, valid = pair.project(3 * RAYS)
        yield (
            pair.rig,
            pair.image_size,
            [field[..., ::3] for field in fields],
            pixels.where(valid[..., None], 0.0),
        )
        yield pair.to_directions()[::5], pair.to_directions(5 * rand(4, 2))


def rig_of(rig: CameraRig) -> Any:
    return rig, rig.origin / 100, rig.center, rig.radius, rig.baselines, rig.axes, rig.max_angles, rig.masks


def lens(name: str) -> Any:
    """Where its pixels look, where it shows directions, and so of a smaller and a cropped image and a narrower view."""
    camera = LENSES[name]
    height, width = camera.image_size
    yield camera.unproject(camera.pixel_grid()[::7, ::9] * 1.1 - 2.3)  # some of it beyond the image
    small, part = camera.resized((height // 2, width - 5)), camera.cropped(3, 5, height - 9, width - 17)
    for other in (
        camera,
        small,
        part,
        *([] if camera.model == "equirectangular" else [camera.with_max_angle(0.8)]),
    ):
        pixels, valid = other.project(RAYS)
        yield valid, pixels.where(valid[:, None], 0.0) / 50


def angles(camera: Any) -> Any:
    rings = visible_angle(camera, 6 * rand(9, seed=5)), cap(1.0, 20, camera)
    return field_of_view(camera), rings, focal_length_on_axis(camera), pixels_a_radian(camera)


MODULES = "cameras.fingerprint cameras.masks cameras.robot_frame cameras.trajectory icosphere.areas"
"""Where names of the table come from, besides those that are public."""

NUMBERS = """
map(rig_of, (FAR, FAR.rotated(0.3, TURN[:3, :3]), FAR.scaled(1.7), FAR.permuted([2, 0, 1]))) -> -27.4638
rig_of(FAR.subset(["b", 0])) -> 75.7787
map(rig_of, (placed(FAR, TURN), FAR.in_world(), FAR.resized((18, 27)), FAR.to(torch.float32))) -> -73.2063
FAR.project_along(RAYS, torch.tensor([0.0, 1.5])), FAR.points_seen(RAYS, torch.tensor([0.0, 2.5])) -> -50.8056
tilt_of(placed(RIG, TURN)), int(rig_fingerprint(RIG), 16) % 1000 -> -166.2884
int(rig_fingerprint(RIG, 1, 3), 16) % 1000 -> 156.1474
[WALK.turned(up) for up in UPS] -> -9.0047
WALK.windows(), WALK.windows(2, 1.5) -> 3.8388
WALK.rig(NARROW, [4, 1, 2], rand(20, 27) > 0.5), WALK.rig(RIG, [5, 0, 3]) -> 3.2201
WALK.rig(RIG, [5, 0, 3]).center -> -1.3509
WALK.of_images(["0.48", "3.503", "6.52", "9"]) -> -0.9177
[float(name) for name in WALK.of_images(["0.48", "9", "6.52"]).names] -> 3.5228
coverage(RIG, RAYS, [0.4, 2.0, math.inf]), seen_by(RIG, RAYS, rand(162)) -> 5.9304
overlap(coverage(RIG, RAYS, [0.4, 2.0]), icosphere_solid_angles(2, torch.float64)) -> 1.1005
sample_sphere(RIG, IMAGES, RAYS), sample_sphere(RIG, IMAGES, RAYS, 0.3, antialias=True) -> 6.5434
map(angles, (A, LENSES["brown conrady"], LENSES["ocam"], LENSES["corner"])) -> -94.1227
pairs("cassini") -> -54.3117
pairs("pinhole", pairs=[("c", "a")], image_size=(22, 31)) -> -1946.8482
pairs("equirectangular", image_size=(20, 24)) -> 557.9955
straighten(LENSES["ocam exact"]) -> -182.1561
straighten_rig(CameraRig([LENSES["ocam"], LENSES["ocam exact"]], WALK.world_from_camera[:2])) -> 275.0212
fit_inverse_polynomial(LENSES["ocam exact"], 6).camera.project(RAYS).pixels / 50 -> -2.1222
depth_from_z(DEEP, A), z_from_depth(DEEP, A), points_from_depth(DEEP, A) -> -181.7105
resized_mask(rand(36, 50) > 0.03, (13, 17)) -> -6.1325
undistorted_camera(LENSES["equisolid"], balance=0.0), undistorted_camera(LENSES["equisolid"], 1.9) -> 107.7636
undistorted_camera(LENSES["equisolid"], balance=0.3) -> 92.5118
undistorted_camera(LENSES["equisolid"], image_size=(30, 50)), undistorted_camera(LENSES["band"]) -> 1.9806
undistorted_camera(B, balance=1) -> 37.4073
undistort(IMAGES["a"], A, balance=0.6), undistort(IMAGES["a"], A, 1.2, mode="area") -> 11.3854
remap(IMAGES["a"], A, WIDE, TURN[:3, :3], fill=0.7, mask=MASK[0]), remap(IMAGES["a"], A, NARROW) -> -1.0215
remap(rand(1, 16, 32), WIDE, NARROW, TURN[:3, :3]), remap_mask(A, WIDE, TURN[:3, :3], mask=MASK) -> -2.6074
remap(IMAGES["a"], A, WIDE, TURN[:3, :3], "area", 0.7, MASK) -> -3.6894
remap(IMAGES["a"], A, NARROW.resized((7, 9)), mode="area") -> 0.4459
remap(rand(1, 16, 32), WIDE, NARROW.resized((3, 4)), TURN[:3, :3], "area") -> -0.4680
remap_mask(A, WIDE.resized((6, 12)), None, "area", MASK) -> -1.3154
remap(IMAGES["a"], A, WIDE, TURN[:3, :3], "bicubic", 0.7) -> -3.6482
remap(rand(1, 16, 32), WIDE, NARROW, None, "bicubic") -> -0.4719
remap(IMAGES["a"], A, WIDE, TURN[:3, :3], "nearest", 0.7) -> -4.8574
remap(rand(1, 16, 32), WIDE, NARROW, None, "nearest") -> -0.2951
remap(DEEP[None], A, WIDE, TURN[:3, :3], "depth", 0.7, MASK[0]) -> -12.5735
compare_cameras(LENSES["equidistant"], LENSES["equisolid"]), compare_cameras(A, B, [0.0, 0.7]) -> -6.0261
converted("equisolid", "kannala_brandt"), converted("equisolid", "kannala_brandt", num_coefficients=2) -> -3.6967
converted("stereographic", "double_sphere", max_angle=1.2) -> -1.0650
converted("equidistant", "pinhole"), converted("double sphere", "fisheye") -> 21.1199
converted("equisolid", "ocam") -> -0.7842
lens("equidistant") -> 13.0152
lens("equisolid") -> 11.2317
lens("stereographic") -> 13.8610
lens("orthographic") -> 14.2943
lens("equirectangular") -> -2.6764
lens("corner") -> -5.9097
lens("from behind") -> -6.0820
lens("band") -> -1.1467
lens("ocam") -> 17.5623
lens("ocam exact") -> 18.4405
lens("double sphere") -> 6.1771
lens("double sphere, xi > 0") -> 14.8029
lens("kannala brandt") -> 7.2508
lens("kannala brandt, 6") -> 13.6145
lens("angle polynomial") -> 9.6958
lens("kannala brandt, skew") -> 8.9075
lens("mei, skew") -> 11.0746
lens("atan") -> 8.5688
lens("division") -> 4.7202
lens("division, 3") -> 7.6755
lens("thin prism fisheye") -> 10.1859
lens("thin prism fisheye, additive") -> 8.4998
lens("brown conrady") -> 9.0271
lens("brown conrady, 14, skew") -> 15.7182
lens("unified") -> 6.5697
lens("unified, xi > 1") -> 11.5746
lens("mei") -> 11.0648
lens("extended unified") -> 15.0291
lens("radial polynomial") -> 7.9689
lens("pinhole") -> 8.9199
lens("pinhole, 80 degrees, skew") -> 12.0777
"""
"""A call -> the sum over the numbers in its result, each weighted by where it stands."""


@pytest.mark.parametrize(("call", "expected"), numbers_in(NUMBERS))
def test_numbers_stay(call: str, expected: float) -> None:
    assert sum_of(call, globals(), MODULES) == pytest.approx(expected, abs=2e-3)
