# SPDX-License-Identifier: Apache-2.0
"""Misuses of the library: each is told in the house's own words, never in those of torch. A new one is one line.

An error names the argument, says what was expected and what came, and is a ``SphericalVisionError``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision.cameras import (
    AtanCamera,
    Camera,
    CameraRig,
    DoubleSphereCamera,
    ExtendedUnifiedCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    OCamCamera,
    PinholeCamera,
    UnifiedCamera,
    convert,
    coverage,
    depth_from_z,
    field_of_view,
    points_from_depth,
    project_fisheye,
    project_pinhole,
    read_camera,
    read_rig,
    remap,
    ring_rig,
    save_camera,
    save_rig,
    undistorted_camera,
)
from sphericalvision.capture import Predictor
from sphericalvision.core import ArgumentTypeError, SphericalVisionError
from sphericalvision.crown import (
    Crown,
    CrownBatchNorm2d,
    CrownConv2d,
    CrownConv3d,
    CrownConvNorm2d,
    CrownConvNorm3d,
    CrownPointwise,
    HexConv2d,
    HexConv3d,
    crown_conv2d,
    crown_max_pool2d,
    crown_relu,
    exchange,
    from_crown,
    to_crown,
)
from sphericalvision.data import Compose, collate_samples, random_rotations
from sphericalvision.geometry import (
    angle_from_axis,
    bilinear_sample,
    directions_from_longitude_latitude,
    invert_transform,
    normalize,
    transform_from_axis_angle,
    transform_from_quaternion,
    transform_points,
)
from sphericalvision.icosphere import Icosphere, icosphere_pool, level_from_num_vertices
from sphericalvision.losses import depth_index_huber, solid_angle_cross_entropy, solid_angle_mean
from sphericalvision.metrics import DepthError, DepthIndexError, SolidAngleMean, angular_error
from sphericalvision.models import DepthNetwork, IcoSweepNet, SemiGlobalSweep, pretrained
from sphericalvision.scenes import make_scene, render_directions, render_rig
from sphericalvision.sphere import (
    Equirectangular,
    SphereConv2d,
    cube_pad,
    equirectangular_pad,
    make_seamless,
    resample,
)
from sphericalvision.sweep import (
    PanoramaSweep,
    SphereSweep,
    depth_from_index,
    index_from_depth,
    soft_argmax,
)
from sphericalvision.viz import crown_picture, icosphere_mesh, rig_picture, save_point_cloud, sphere_mesh

NAN = math.nan
EYE, EYES = torch.eye(3), torch.eye(4)[None]
F, C, SIZE = [20.0, 20.0], [19.5, 15.5], (32, 40)
ARRAY = np.zeros((32, 40, 3), np.uint8)
POINTS, INTEGERS = np.zeros((5, 3)), torch.tensor([[0, 0, 1]])
IMAGE, BYTES = torch.zeros(3, 32, 40), torch.zeros(3, 32, 40, dtype=torch.uint8)
DIRECTIONS = torch.tensor([[0.0, 0.6, 0.8]])
VALUES = torch.zeros(1, 3, 162)
LABELS = torch.zeros(1, 162, dtype=torch.long)


@functools.cache
def camera() -> Camera:
    return FisheyeCamera.from_field_of_view(SIZE, 3.6)


@functools.cache
def rig() -> CameraRig:
    return ring_rig(4, image_size=(24, 24))


@functools.cache
def ico() -> Icosphere:
    return Icosphere(2)


@functools.cache
def net() -> DepthNetwork:
    return IcoSweepNet(level=4, num_hypotheses=8, min_depth=0.5, feature_channels=4, num_cameras=4)


@functools.cache
def sweep() -> SphereSweep:
    return SphereSweep(2, 8, 0.5)


@functools.cache
def predictor() -> Predictor:
    return Predictor(rig(), method="semi_global", level=3, min_depth=0.5)


def pinhole(focal_length: Any = F, size: Any = SIZE, max_angle: Any = 1.0) -> PinholeCamera:
    return PinholeCamera(focal_length, C, size, max_angle)


def crown(dtype: torch.dtype = torch.float32, *size: int) -> Crown:
    return to_crown(torch.zeros(1, 3, *size, 162, dtype=dtype))


def sees(images: Any) -> Any:
    return predictor()(images)


def pictures(image: Any) -> dict[str, Any]:
    return dict.fromkeys(rig().names, image)


DOUBLE = torch.float64
# (the call, the argument that the message begins with or names, further words of the message)
MISUSES: dict[str, tuple[Callable[[], Any], str, str]] = {
    # what a camera is made of
    "NaN focal length": (lambda: pinhole([NAN, 20.0]), "focal_length", "finite"),
    "negative focal length": (lambda: pinhole([-20.0, 20.0]), "focal_length", "above 0"),
    "focal length of words": (lambda: pinhole("long"), "focal_length", "expected numbers"),
    "no focal length": (lambda: pinhole(None), "focal_length", "got None"),
    "three focal lengths": (lambda: pinhole([1.0, 2.0, 3.0]), "focal_length", r"\(\*, 2\)"),
    "intrinsics in half precision": (lambda: pinhole(torch.ones(2).half()), "dtype", "float32 or float64"),
    "size of one number": (lambda: pinhole(size=4), "image_size", "got 4"),
    "size of half a pixel": (lambda: pinhole(size=(4.5, 4)), "image_size", "whole pixels"),
    "negative size": (lambda: pinhole(size=(-4, 4)), "image_size", "above 0"),
    "size of words": (lambda: pinhole(size=("big", "small")), "image_size", "whole pixels"),
    "size NaN": (lambda: pinhole(size=(NAN, 4)), "image_size", "nan"),
    "infinite size": (lambda: pinhole(size=(math.inf, 4)), "image_size", "inf"),
    "a gigapixel": (lambda: pinhole(size=(40_000, 40_000)), "image_size", "134,217,728"),
    "field of view in degrees": (lambda: pinhole(max_angle=110), "max_angle", "radians"),
    "field of view in words": (lambda: pinhole(max_angle="wide"), "max_angle", "expected numbers"),
    "no distortion": (lambda: KannalaBrandtCamera(F, C, None, SIZE), "distortion", "got None"),
    "alpha of 2": (lambda: DoubleSphereCamera(F, C, 0.0, 2.0, SIZE), "alpha", "got"),
    "beta below 0": (lambda: ExtendedUnifiedCamera(F, C, 0.5, -1.0, SIZE), "beta", "got"),
    "xi below 0": (lambda: UnifiedCamera(F, C, -1.0, None, SIZE), "xi", "got"),
    "an atan camera of 0": (lambda: AtanCamera(F, C, 0.0, SIZE), "field_of_view|omega|w", "got"),
    "no polynomial": (lambda: OCamCamera([], None, C, [1.0, 0, 0], SIZE, 1.0), "polynomial", "got"),
    "affine of NaN": (lambda: OCamCamera([-9.0, 0.1], None, C, [1, 0, NAN], SIZE, 1.0), "affine", "finite"),
    "unknown projection": (lambda: FisheyeCamera("fish", 5.0, C, SIZE), "projection", "equidistant"),
    "220 for 220°": (lambda: FisheyeCamera.from_field_of_view(SIZE, 220), "field_of_view", "rad"),
    "'220' for 220°": (lambda: FisheyeCamera.from_field_of_view(SIZE, "220"), "field_of_view", "'220'"),
    # what a camera is given
    "integer points": (lambda: camera().project(INTEGERS), "points", "floating point"),
    "points of numpy": (lambda: camera().project(POINTS), "points", r"numpy.ndarray \(5, 3\).*from_numpy"),
    "points in a list": (lambda: camera().project([[0.0, 0.0, 1.0]]), "points", "got list; torch.tensor"),
    "no points": (lambda: camera().project(None), "points", "got NoneType"),
    "complex points": (lambda: camera().project(DIRECTIONS.to(torch.complex64)), "points", "complex64"),
    "points of two numbers": (
        lambda: camera().project(torch.zeros(5, 2)),
        "points",
        r"\(\*, 3\), got \(5, 2\)",
    ),
    "integer pixels": (lambda: camera().unproject(torch.tensor([[1, 2]])), "pixels", "floating point"),
    "pixels of numpy": (lambda: camera().unproject(np.zeros((2, 2))), "pixels", "numpy"),
    "pixels of numpy to contain": (lambda: camera().contains(np.zeros((2, 2))), "pixels", "numpy"),
    "image of numpy": (lambda: camera().sample(ARRAY, DIRECTIONS), "image", "channels before height"),
    "image of bytes": (lambda: camera().sample(BYTES, DIRECTIONS), "image", "uint8"),
    "image with channels last": (
        lambda: camera().sample(torch.zeros(32, 40, 3), DIRECTIONS),
        "image",
        "32 x 40",
    ),
    "resized to words": (lambda: camera().resized("big"), "image_size", "'big'"),
    "cropped between pixels": (lambda: camera().cropped(0.5, 0, 4, 4), "cropped", "whole pixels"),
    "cropped too far": (lambda: camera().cropped(0, 0, 400, 4), "cropped", "inside"),
    "half precision camera": (lambda: camera().to(torch.float16), "dtype", "float32 or float64"),
    "one of a single camera": (lambda: camera().select(0), "index", "got 0"),
    "a stack of nothing": (lambda: FisheyeCamera.stack([]), "cameras", "at least one"),
    "unknown model": (lambda: convert(camera(), to="fishy"), "to", "kannala_brandt"),
    "a model that is no camera": (lambda: convert(camera(), to=int), "to", "int"),
    "intrinsics in a list": (
        lambda: project_pinhole(DIRECTIONS, [1.0, 1.0], torch.ones(2)),
        "focal_length",
        "got list",
    ),
    "points of numpy to a function": (
        lambda: project_fisheye(POINTS, torch.ones(2), torch.ones(2), "equidistant"),
        "points",
        "numpy",
    ),
    "z of numpy": (lambda: depth_from_z(np.zeros(SIZE), camera()), "z", "numpy"),
    "integer depth": (lambda: points_from_depth(torch.ones(SIZE).long(), camera()), "depth", "int64"),
    "a view of a number": (lambda: field_of_view(3), "camera", "expected a Camera, got 3"),
    "the view of a text": (lambda: undistorted_camera("camera"), "camera", "'camera'"),
    "a camera file that is a number": (lambda: read_camera(3), "path", "got 3"),
    "a camera that is a number": (lambda: save_camera(3, "x.yaml"), "camera", "got 3"),
    # rigs
    "no cameras": (lambda: CameraRig([], torch.zeros(0, 4, 4)), "cameras", "at least one"),
    "a camera for a list": (lambda: CameraRig(camera(), EYES), "cameras", r"write \[camera\]"),
    "names for cameras": (lambda: CameraRig(["front"], EYES), r"cameras\['cam1'\]", "'front'"),
    "poses of 3 x 3": (lambda: CameraRig([camera()], EYE[None]), "world_from_camera", "4, 4"),
    "poses of numpy": (lambda: CameraRig([camera()], np.eye(4)[None]), "world_from_camera", "numpy"),
    "poses in a list": (lambda: CameraRig([camera()], [EYES[0]]), "world_from_camera", "got list"),
    "integer poses": (lambda: CameraRig([camera()], EYES.long()), "world_from_camera", "int64"),
    "poses of NaN": (lambda: CameraRig([camera()], EYES * NAN), "world_from_camera", "cam1"),
    "twice a rotation": (
        lambda: CameraRig([camera()], torch.diag(torch.tensor([2.0, 2, 2, 1]))[None]),
        "world_from_camera",
        "orthonormal",
    ),
    "a mirror": (
        lambda: CameraRig([camera()], torch.diag(torch.tensor([-1.0, 1, 1, 1]))[None]),
        "world_from_camera",
        "mirror",
    ),
    "poses that act on rows": (
        lambda: CameraRig([camera()], EYES + torch.eye(4).roll(3, 1).triu(3).mT),
        "world_from_camera",
        "last rows",
    ),
    "masks of numpy": (
        lambda: CameraRig([camera()], EYES, {"cam1": np.ones(SIZE)}),
        r"masks\['cam1'\]",
        "numpy",
    ),
    "masks of floats": (
        lambda: CameraRig([camera()], EYES, {"cam1": torch.ones(SIZE)}),
        r"masks\['cam1'\]",
        "bool",
    ),
    "masks of nobody": (lambda: CameraRig([camera()], EYES, {"x": torch.ones(SIZE)}), "masks", "cam1"),
    "unknown camera": (lambda: rig().subset(["front"]), "cameras", "cam1, cam2"),
    "a rig turned by 2": (lambda: rig().rotated(rotation=2 * EYE), "rotation", "orthonormal"),
    "points of numpy to a rig": (lambda: rig().project(POINTS), "points", "numpy"),
    "a ring of half a camera": (lambda: ring_rig(2.5), "num_cameras", "whole number of 2 or more"),
    "a ring of one": (lambda: ring_rig(1), "num_cameras", "got 1"),
    "a ring without a size": (lambda: ring_rig(4, radius=0.0), "radius", "above 0"),
    "a ring of NaN": (lambda: ring_rig(4, radius=NAN), "radius", "nan"),
    "a rig file that is a number": (lambda: read_rig(3), "path", "got 3"),
    "a rig that is a camera": (lambda: save_rig(camera(), "x.yaml"), "rig", "FisheyeCamera"),
    "coverage of a camera": (lambda: coverage(camera(), DIRECTIONS, [1.0]), "rig", "FisheyeCamera"),
    "a picture of a camera": (lambda: rig_picture(camera()), "rig", "FisheyeCamera"),
    # images from camera to camera, grid to grid
    "remap of numpy": (lambda: remap(ARRAY, camera(), camera()), "image", "numpy"),
    "remap of bytes": (lambda: remap(BYTES, camera(), camera()), "values", "uint8.*nearest"),
    "remap by 2": (lambda: remap(IMAGE, camera(), camera(), 2 * EYE), "rotation", "orthonormal"),
    "remap by numpy": (lambda: remap(IMAGE, camera(), camera(), np.eye(3)), "rotation", "numpy"),
    "remap to a size": (lambda: remap(IMAGE, camera(), SIZE), "target", "expected a Camera"),
    "remap filled with words": (lambda: remap(IMAGE, camera(), camera(), fill="black"), "fill", "'black'"),
    "remap in no mode": (lambda: remap(IMAGE, camera(), camera(), mode="cubic"), "mode", "'bicubic'"),
    "resample of numpy": (lambda: resample(ARRAY, camera(), ico()), "values", "numpy"),
    "resample of bytes": (lambda: resample(BYTES, camera(), ico()), "values", "uint8.*nearest"),
    "resample by 2": (lambda: resample(IMAGE, camera(), ico(), 2 * EYE), "rotation", "orthonormal"),
    "resample by 4 x 4": (lambda: resample(IMAGE, camera(), ico(), torch.eye(4)), "rotation", r"\(4, 4\)"),
    "resample to a level": (lambda: resample(IMAGE, camera(), 5), "target", "Icosphere"),
    "resample of a rig": (lambda: resample(IMAGE, rig(), ico()), "source", "CameraRig"),
    "resample with channels last": (
        lambda: resample(torch.zeros(32, 40, 3), camera(), ico()),
        "values",
        "32, 40",
    ),
    "resample by a mask of numpy": (
        lambda: resample(IMAGE, camera(), ico(), mask=np.ones(SIZE)),
        "mask",
        "numpy",
    ),
    # geometry
    "an image of numpy between pixels": (lambda: bilinear_sample(ARRAY, torch.zeros(5, 2)), "image", "numpy"),
    "integer places": (lambda: bilinear_sample(IMAGE, torch.zeros(5, 2).long()), "pixels", "int64"),
    "batches that do not fit": (
        lambda: bilinear_sample(torch.zeros(2, 3, 4, 4), torch.zeros(3, 5, 2)),
        "image and pixels",
        "broadcast",
    ),
    "integers of length 1": (lambda: normalize(INTEGERS), "vectors", "int64"),
    "the angle of integers": (lambda: angle_from_axis(INTEGERS), "points", "int64"),
    "longitudes of numpy": (
        lambda: directions_from_longitude_latitude(np.zeros(3), torch.zeros(3)),
        "longitude",
        "numpy",
    ),
    "a transform of numpy": (lambda: invert_transform(np.eye(4)), "a_from_b", "numpy"),
    "a transform of 3 x 3": (lambda: invert_transform(EYE), "a_from_b", "4, 4"),
    "integers transformed": (lambda: transform_points(torch.eye(4), INTEGERS), "points", "int64"),
    "no quaternion": (
        lambda: transform_from_quaternion(torch.zeros(4), torch.zeros(3)),
        "quaternion",
        "zero",
    ),
    "an axis of integers": (lambda: transform_from_axis_angle(INTEGERS, DIRECTIONS), "axis_angle", "int64"),
    # icospheres and grids
    "level -1": (lambda: Icosphere(-1), "level", "0 .*10"),
    "level 30": (lambda: Icosphere(30), "level", "ten million"),
    "level '5'": (lambda: Icosphere("5"), "level", "'5'"),
    "integer vertices": (lambda: Icosphere(2, torch.int64), "dtype", "floating"),
    "values of numpy": (lambda: ico().sample(np.zeros((3, 162)), DIRECTIONS), "values", "numpy"),
    "integers between vertices": (lambda: ico().sample(LABELS, DIRECTIONS), "values", "int64"),
    "values of another level": (lambda: ico().sample(torch.zeros(3, 42), DIRECTIONS), "values", "level 2"),
    "directions of numpy": (lambda: ico().locate(POINTS), "directions", "numpy"),
    "pooling of numpy": (lambda: icosphere_pool(np.zeros((3, 162))), "values", "numpy"),
    "100 vertices": (lambda: icosphere_pool(torch.zeros(3, 100)), "number of vertices", "642"),
    "vertices in words": (lambda: level_from_num_vertices("many"), "number of vertices", "'many'"),
    "a panorama of half a row": (lambda: Equirectangular(4.5, 8), "height", "4.5"),
    "a panorama of numpy": (
        lambda: Equirectangular(8, 16).sample(np.zeros((3, 8, 16)), DIRECTIONS),
        "values",
        "numpy",
    ),
    "integer directions": (
        lambda: Equirectangular(8, 16).sample(torch.zeros(3, 8, 16), INTEGERS),
        "directions",
        "int64",
    ),
    "five faces": (lambda: cube_pad(torch.zeros(1, 3, 5, 4, 4), 1), "faces", "6, S, S"),
    "faces of numpy": (lambda: cube_pad(np.zeros((1, 3, 6, 4, 4)), 1), "faces", "numpy"),
    "more padding than face": (lambda: cube_pad(torch.zeros(1, 3, 6, 4, 4), 9), "padding", "9"),
    "padding of numpy": (lambda: equirectangular_pad(np.zeros((3, 8, 16)), 1), "images", "numpy"),
    "a seamless number": (lambda: make_seamless(3), "module", "got 3"),
    "doubles in a sphere layer": (
        lambda: SphereConv2d(3, 4)(torch.zeros(1, 3, 8, 16, dtype=DOUBLE)),
        "images",
        "float32.*float64",
    ),
    "negative channels on a sphere": (lambda: SphereConv2d(-3, 4), "in_channels", "-3"),
    # crowns
    "a plain tensor in CrownConv2d": (lambda: CrownConv2d(3, 4)(VALUES), "crown", "to_crown"),
    "a plain tensor in CrownConv3d": (lambda: CrownConv3d(3, 4)(VALUES), "crown", "to_crown"),
    "a plain tensor rectified": (lambda: crown_relu(VALUES), "crown", "to_crown"),
    "a plain tensor exchanged": (lambda: exchange(VALUES), "crown", "to_crown"),
    "a plain tensor folded": (lambda: from_crown(VALUES), "crown", "to_crown"),
    "a plain tensor pooled": (lambda: crown_max_pool2d(VALUES), "crown", "to_crown"),
    "a plain tensor normalised": (lambda: CrownBatchNorm2d(3)(VALUES), "crown", "to_crown"),
    "a plain tensor at each place": (lambda: CrownPointwise(torch.nn.ReLU())(VALUES), "crown", "to_crown"),
    "a plain tensor drawn": (lambda: crown_picture(VALUES), "crown", "to_crown"),
    "a crown without a batch": (lambda: to_crown(VALUES[0]), "values", r"\(B, C, V\)"),
    "a crown of numpy": (lambda: to_crown(np.zeros((1, 3, 162))), "values", "numpy"),
    "doubles in CrownConv2d": (
        lambda: CrownConv2d(3, 4)(crown(DOUBLE)),
        "crown",
        r"float32.*\.to\(torch.float32",
    ),
    "doubles in CrownConv3d": (lambda: CrownConv3d(3, 4)(crown(DOUBLE, 4)), "crown", "float64"),
    "doubles in CrownConvNorm2d": (lambda: CrownConvNorm2d(3, 4)(crown(DOUBLE)), "crown", "float64"),
    "doubles in CrownConvNorm3d": (lambda: CrownConvNorm3d(3, 4)(crown(DOUBLE, 4)), "crown", "float64"),
    "doubles in CrownBatchNorm2d": (lambda: CrownBatchNorm2d(3)(crown(DOUBLE)), "crown", "float64"),
    "doubles at each place": (
        lambda: CrownPointwise(torch.nn.Conv2d(3, 4, 1))(crown(DOUBLE)),
        "crown",
        "float64",
    ),
    "doubles in HexConv2d": (lambda: HexConv2d(3, 4)(VALUES.double()), "values", "float64"),
    "doubles in HexConv3d": (
        lambda: HexConv3d(3, 4)(torch.zeros(1, 3, 4, 162).double()),
        "values",
        "float64",
    ),
    "integers in CrownConv2d": (lambda: CrownConv2d(3, 4)(crown(torch.int64)), "crown", "int64"),
    "five channels of three": (lambda: CrownConv2d(5, 4)(crown()), "crown", "5 channels"),
    "hypotheses in a plane": (lambda: CrownConv2d(3, 4)(crown(torch.float32, 4)), "crown", "to_crown"),
    "negative channels": (lambda: CrownConv2d(-3, 4), "in_channels", "-3"),
    "a stride of 3": (lambda: CrownConv2d(3, 4, stride=3), "stride", "1 or 2"),
    "a weight of numpy": (lambda: crown_conv2d(crown(), np.zeros((4, 3, 7))), "weight", "numpy"),
    "a bias of others": (
        lambda: crown_conv2d(crown(), torch.zeros(4, 3, 7), torch.zeros(3)),
        "bias",
        r"\(4,\)",
    ),
    "a crown in HexConv2d": (lambda: HexConv2d(3, 4)(crown()), "values", "from_crown"),
    "a crown plus a tensor": (lambda: crown() + VALUES, "crown", "to_crown"),
    "a crown plus another level": (lambda: crown() + to_crown(torch.zeros(1, 3, 42)), "crown", "col"),
    # sweeps and networks
    "features of numpy": (lambda: sweep()(np.zeros((1, 4, 5, 162)), rig()), "features", "numpy"),
    "integer features": (lambda: sweep()(torch.zeros(1, 4, 5, 162).long(), rig()), "features", "int64"),
    "features of three": (lambda: sweep()(torch.zeros(1, 3, 5, 162), rig()), "features", "rig.names"),
    "features of another level": (lambda: sweep()(torch.zeros(1, 4, 5, 42), rig()), "features", "162"),
    "a list for a rig": (
        lambda: sweep()(torch.zeros(1, 1, 5, 162), [camera()]),
        "rig",
        "CameraRig, got list",
    ),
    "a camera for a rig": (lambda: sweep()(torch.zeros(1, 1, 5, 162), camera()), "rig", "FisheyeCamera"),
    "a rig of panoramas": (lambda: PanoramaSweep((8, 16), 8, 0.5).tables(camera()), "rig", "FisheyeCamera"),
    "seen in floats": (lambda: sweep()(torch.zeros(1, 4, 5, 162), rig(), torch.ones(4, 162)), "seen", "bool"),
    "seen of numpy": (lambda: sweep()(torch.zeros(1, 4, 5, 162), rig(), np.ones((4, 162))), "seen", "numpy"),
    "one hypothesis": (lambda: SphereSweep(2, 1, 0.5), "num_hypotheses", "2 or more"),
    "half a hypothesis": (lambda: SphereSweep(2, 8.5, 0.5), "num_hypotheses", "8.5"),
    "a billion hypotheses": (lambda: SphereSweep(2, 10**9, 0.5), "num_hypotheses", "4096"),
    "depth 0": (lambda: SphereSweep(2, 8, 0.0), "min_depth", "positive"),
    "depth NaN": (lambda: SphereSweep(2, 8, NAN), "min_depth", "nan"),
    "depth near": (lambda: SphereSweep(2, 8, "near"), "min_depth", "'near'"),
    "indices of numpy": (lambda: depth_from_index(np.zeros(3), 8, 0.5), "index", "numpy"),
    "integer depths": (lambda: index_from_depth(torch.ones(3).long(), 8, 0.5), "depth", "int64"),
    "scores of numpy": (lambda: soft_argmax(np.zeros((8, 162))), "logits", "numpy"),
    "integer scores": (lambda: soft_argmax(torch.zeros(8, 162).long()), "logits", "int64"),
    "images of numpy": (lambda: net()(np.zeros((1, 4, 3, 2562)), rig()), "images", "numpy"),
    "images of doubles": (lambda: net()(torch.zeros(1, 4, 3, 2562).double(), rig()), "images", "float64"),
    "images of bytes in a network": (
        lambda: net()(torch.zeros(1, 4, 3, 2562).byte(), rig()),
        "images",
        "uint8",
    ),
    "images of another level": (lambda: net()(torch.zeros(1, 4, 3, 162), rig()), "images", "level 4"),
    "images of three cameras": (
        lambda: net()(torch.zeros(1, 3, 3, 2562), rig().subset([0, 1, 2])),
        "images",
        "4 cameras",
    ),
    "no rig": (lambda: net()(torch.zeros(1, 4, 3, 2562), None), "rig", "got None"),
    "images of numpy without a network": (
        lambda: SemiGlobalSweep(3, 8, 0.5)(np.zeros((1, 4, 3, 642)), rig()),
        "images",
        "numpy",
    ),
    "unknown weights": (lambda: pretrained("resnet"), "name", "refinedsweepnet"),
    # losses and metrics
    "a loss of numpy": (
        lambda: depth_index_huber(np.zeros((1, 5)), torch.zeros(1, 5)),
        "pred_index",
        "numpy",
    ),
    "a negative delta": (
        lambda: depth_index_huber(torch.zeros(1, 5), torch.zeros(1, 5), delta=-1.0),
        "delta",
        "-1.0",
    ),
    "a mean of numpy": (lambda: solid_angle_mean(np.zeros((1, 162)), ico().solid_angles), "values", "numpy"),
    "labels of floats": (
        lambda: solid_angle_cross_entropy(torch.zeros(1, 2, 162), VALUES[:, 0], ico().solid_angles),
        "labels",
        "int64",
    ),
    "label 7 of 2": (
        lambda: solid_angle_cross_entropy(torch.zeros(1, 2, 162), LABELS + 7, ico().solid_angles),
        "labels",
        "0 to 1",
    ),
    "an error of numpy": (
        lambda: DepthIndexError(8).update(np.zeros((1, 3)), torch.zeros(1, 3)),
        "pred",
        "numpy",
    ),
    "a depth of numpy": (lambda: DepthError().update(torch.ones(1, 3), np.ones((1, 3))), "target", "numpy"),
    "a metric on a number": (lambda: SolidAngleMean(3), "grid", "SphereGrid, got 3"),
    "angles of integers": (lambda: angular_error(INTEGERS, DIRECTIONS), "pred", "int64"),
    # scenes and samples
    "the scene of a word": (lambda: make_scene("room", seed="a"), "seed", "'a'"),
    "the scene of nothing": (lambda: make_scene("moon"), "kind", "'room'"),
    "a picture of nothing": (lambda: render_rig(None, rig()), "scene", "make_scene"),
    "a picture by a camera": (lambda: render_rig(make_scene("bare"), camera()), "rig", "FisheyeCamera"),
    "rays of numpy": (
        lambda: render_directions(make_scene("bare"), torch.zeros(3), POINTS),
        "directions",
        "numpy",
    ),
    "samples that are numbers": (lambda: collate_samples([3]), "samples", "got 3"),
    "minus one rotation": (lambda: random_rotations(-1), "count", "-1"),
    "a list of transforms": (lambda: Compose([max, min]), "transforms", "takes no list"),
    # pictures and points
    "points of numpy in a file": (
        lambda: save_point_cloud("x.ply", POINTS, torch.zeros(5, 3)),
        "points",
        "numpy",
    ),
    "points in a text": (lambda: save_point_cloud("x.doc", DIRECTIONS, DIRECTIONS), "path", "'.ply'"),
    "a mesh of a level": (lambda: icosphere_mesh(5), "depth", "got int"),
    "a sphere of an icosphere": (lambda: sphere_mesh(ico()), "values", "Icosphere"),
    # depth of a rig
    "one camera": (lambda: Predictor(rig().subset(["cam1"]), min_depth=0.5), "rig", r"two or more.*\(cam1\)"),
    "cameras in one place": (
        lambda: Predictor(CameraRig([camera()] * 2, EYES.repeat(2, 1, 1)), min_depth=0.5),
        "rig",
        "one place",
    ),
    "a predictor of a camera": (lambda: Predictor(camera()), "rig", "FisheyeCamera"),
    "level 50": (lambda: Predictor(rig(), method="semi_global", level=50), "level", "50"),
    "an unknown device": (lambda: Predictor(rig(), device="gpu"), "device", "'cpu'"),
    "no such method": (lambda: Predictor(rig(), method="magic"), "method", "'semi_global'"),
    "hypotheses -1": (lambda: Predictor(rig(), num_hypotheses=-1), "num_hypotheses", "-1"),
    "images that are a number": (lambda: sees(3), "images", "got int"),
    "an image that is a file": (lambda: sees(pictures("a.png")), "images.*cam1", "uint8"),
    "an image missing": (lambda: sees({"cam1": torch.zeros(3, 24, 24)}), "images", "cam2"),
    "an image of another size": (lambda: sees(pictures(torch.zeros(3, 5, 24))), "cam1", "24 x 24"),
    "levels of 255 in floats": (lambda: sees(pictures(torch.full((3, 24, 24), 200.0))), "cam1", "200"),
    "an image of NaN": (lambda: sees(pictures(torch.full((3, 24, 24), NAN))), "cam1", "nan|NaN|finite"),
}


@pytest.mark.parametrize("name", MISUSES)
def test_misuse_is_told_in_our_own_words(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    call, argument, words = MISUSES[name]
    monkeypatch.chdir(tmp_path)  # nothing is written, but if it were
    with pytest.raises(SphericalVisionError, match=f"(?s)({argument}).*({words})") as caught:
        call()
    assert len(str(caught.value)) < 700
    assert not list(tmp_path.iterdir())


def test_an_argument_of_another_type_is_a_type_error_too() -> None:
    with pytest.raises(TypeError) as caught:
        camera().project(POINTS)
    assert isinstance(caught.value, ArgumentTypeError)
    assert isinstance(caught.value, ValueError)


def test_float64_layers_take_float64_and_autocast_takes_what_it_casts() -> None:
    layer = CrownConv2d(3, 4)
    with torch.autocast("cpu", torch.bfloat16):
        assert layer(to_crown(VALUES.bfloat16())).col.dtype == torch.bfloat16
    assert layer.double()(crown(DOUBLE)).col.dtype == DOUBLE
