# SPDX-License-Identifier: Apache-2.0
"""Misuses of the library: each is told in the house's own words, never in those of torch. A new one is one line.

An error names the argument, says what was expected and what came, and is a ``SphericalVisionError``.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import sphericalvision
from sphericalvision.cameras import Camera, CameraRig, FisheyeCamera, PinholeCamera, ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.core import ArgumentTypeError, SphericalVisionError
from sphericalvision.crown import Crown, CrownConv2d, to_crown
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork, IcoSweepNet
from sphericalvision.sweep import SphereSweep

NAN = math.nan
EYE, EYES = torch.eye(3), torch.eye(4)[None]
F, C, SIZE = [20.0, 20.0], [19.5, 15.5], (32, 40)
ARRAY = np.zeros((32, 40, 3), np.uint8)
POINTS, INTEGERS = np.zeros((5, 3)), torch.tensor([[0, 0, 1]])
IMAGE, BYTES = torch.zeros(3, 32, 40), torch.zeros(3, 32, 40, dtype=torch.uint8)
DIRECTIONS = torch.tensor([[0.0, 0.6, 0.8]])
VALUES = torch.zeros(1, 3, 162)
IMAGES, SEEN = torch.zeros(1, 4, 3, 642), torch.ones(4, 642, dtype=torch.bool)
VIEWS = torch.zeros(1, 4, 3, 24, 24)
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


def blank() -> dict[str, Any]:
    return pictures(torch.zeros(3, 24, 24))


def at_once() -> CameraRig:
    """A rig whose cameras are all in one place."""
    return rig().replaced(world_from_camera=EYES.repeat(4, 1, 1))


DOUBLE = torch.float64

MISUSES = r"""
# what a camera is made of
pinhole([NAN, 20.0]) -> focal_length: finite
pinhole([-20.0, 20.0]) -> focal_length: above 0
pinhole('long') -> focal_length: expected numbers
pinhole(None) -> focal_length: got None
pinhole([1.0, 2.0, 3.0]) -> focal_length: \(\*, 2\)
pinhole(torch.ones(2).half()) -> dtype: float32 or float64
pinhole(size=4) -> image_size: got 4
pinhole(size=(4.5, 4)) -> image_size: whole pixels
pinhole(size=(-4, 4)) -> image_size: above 0
pinhole(size=('big', 'small')) -> image_size: whole pixels
pinhole(size=(NAN, 4)) -> image_size: nan
pinhole(size=(math.inf, 4)) -> image_size: inf
pinhole(size=(40000, 40000)) -> image_size: 134,217,728
pinhole(max_angle=110) -> max_angle: radians
pinhole(max_angle='wide') -> max_angle: expected numbers
KannalaBrandtCamera(F, C, None, SIZE) -> distortion: got None
DoubleSphereCamera(F, C, 0.0, 2.0, SIZE) -> alpha: got
ExtendedUnifiedCamera(F, C, 0.5, -1.0, SIZE) -> beta: got
UnifiedCamera(F, C, -1.0, None, SIZE) -> xi: got
AtanCamera(F, C, 0.0, SIZE) -> field_of_view|omega|w: got
OCamCamera([], None, C, [1.0, 0, 0], SIZE, 1.0) -> polynomial: got
OCamCamera([-9.0, 0.1], None, C, [1, 0, NAN], SIZE, 1.0) -> affine: finite
FisheyeCamera('fish', 5.0, C, SIZE) -> projection: equidistant
FisheyeCamera.from_field_of_view(SIZE, 220) -> field_of_view: rad
FisheyeCamera.from_field_of_view(SIZE, '220') -> field_of_view: '220'
# what a camera is given
camera().project(INTEGERS) -> points: floating point
camera().project(POINTS) -> points: numpy.ndarray \(5, 3\).*from_numpy
camera().project([[0.0, 0.0, 1.0]]) -> points: got list; torch.tensor
camera().project(None) -> points: got NoneType
camera().project(DIRECTIONS.to(torch.complex64)) -> points: complex64
camera().project(torch.zeros(5, 2)) -> points: \(\*, 3\), got \(5, 2\)
camera().unproject(torch.tensor([[1, 2]])) -> pixels: floating point
camera().unproject(np.zeros((2, 2))) -> pixels: numpy
camera().contains(np.zeros((2, 2))) -> pixels: numpy
camera().sample(ARRAY, DIRECTIONS) -> image: channels before height
camera().sample(BYTES, DIRECTIONS) -> image: uint8
camera().sample(torch.zeros(32, 40, 3), DIRECTIONS) -> image: movedim
camera().with_intrinsics(focal_length=200.0) -> focal_length: float
PinholeCamera.from_field_of_view((8, 8), (1.0,)) -> field_of_view: radians
undistorted_camera(camera(), (1.0, 1.0)) -> field_of_view: radians
perspective_views(torch.zeros(3, 32, 40), [(0, 0, 0)]) -> image: source=
ico().nearest(torch.tensor([NAN, 0.0, 1.0])) -> directions: NaN
camera().resized('big') -> image_size: 'big'
camera().cropped(0.5, 0, 4, 4) -> cropped: whole pixels
camera().cropped(0, 0, 400, 4) -> cropped: inside
camera().to(torch.float16) -> dtype: float32 or float64
camera().select(0) -> index: got 0
FisheyeCamera.stack([]) -> cameras: at least one
convert(camera(), to='fishy') -> to: kannala_brandt
convert(camera(), to=int) -> to: int
project_pinhole(DIRECTIONS, [1.0, 1.0], torch.ones(2)) -> focal_length: got list
project_fisheye(POINTS, torch.ones(2), torch.ones(2), 'equidistant') -> points: numpy
depth_from_z(np.zeros(SIZE), camera()) -> z: numpy
points_from_depth(torch.ones(SIZE).long(), camera()) -> depth: int64
field_of_view(3) -> camera: expected a Camera, got 3
undistorted_camera('camera') -> camera: 'camera'
undistort(IMAGE[0], camera(), 1.0) -> image: a grey image has a channel, too: image\[None\]
rectified_pairs(rig(), 'panorama') -> kind: 'cassini', 'pinhole'
compare_cameras(camera(), camera().resized((16, 20))) -> second: 32 x 40 pixels .* got 16 x 20
read_camera(3) -> path: got 3
save_camera(3, 'x.yaml') -> camera: got 3
# rigs
CameraRig([], torch.zeros(0, 4, 4)) -> cameras: at least one
CameraRig(camera(), EYES) -> cameras: write \[camera\]
CameraRig(['front'], EYES) -> cameras\['cam1'\]: 'front'
CameraRig([camera()], EYE[None]) -> world_from_camera: 4, 4
CameraRig([camera()], np.eye(4)[None]) -> world_from_camera: numpy
CameraRig([camera()], [EYES[0]]) -> world_from_camera: got list
CameraRig([camera()], EYES.long()) -> world_from_camera: int64
CameraRig([camera()], EYES * NAN) -> world_from_camera: cam1
CameraRig([camera()], torch.diag(torch.tensor([2.0, 2, 2, 1]))[None]) -> world_from_camera: orthonormal
CameraRig([camera()], torch.diag(torch.tensor([-1.0, 1, 1, 1]))[None]) -> world_from_camera: mirror
CameraRig([camera()], EYES + torch.eye(4).roll(3, 1).triu(3).mT) -> world_from_camera: last rows
CameraRig([camera()], EYES, {'cam1': np.ones(SIZE)}) -> masks\['cam1'\]: numpy
CameraRig([camera()], EYES, {'cam1': torch.ones(SIZE)}) -> masks\['cam1'\]: bool
CameraRig([camera()], EYES, {'x': torch.ones(SIZE)}) -> masks: cam1
rig().subset(['front']) -> cameras: cam1, cam2
rig().rotated(rotation=2 * EYE) -> rotation: orthonormal
rig().project(POINTS) -> points: numpy
ring_rig(2.5) -> num_cameras: whole number of 2 or more
ring_rig(1) -> num_cameras: got 1
ring_rig(4, radius=0.0) -> radius: above 0
ring_rig(4, radius=NAN) -> radius: nan
read_rig(3) -> path: got 3
save_rig(camera(), 'x.yaml') -> rig: FisheyeCamera
coverage(camera(), DIRECTIONS, [1.0]) -> rig: FisheyeCamera
rig_picture(camera()) -> rig: FisheyeCamera
# images from camera to camera, grid to grid
remap(ARRAY, camera(), camera()) -> image: numpy
remap(BYTES, camera(), camera()) -> values: uint8.*nearest
remap(IMAGE, camera(), camera(), 2 * EYE) -> rotation: orthonormal
remap(IMAGE, camera(), camera(), np.eye(3)) -> rotation: numpy
remap(IMAGE, camera(), SIZE) -> target: expected a Camera
remap(IMAGE, camera(), camera(), fill='black') -> fill: 'black'
remap(IMAGE, camera(), camera(), mode='cubic') -> mode: 'bicubic'
resample(ARRAY, camera(), ico()) -> values: numpy
resample(BYTES, camera(), ico()) -> values: uint8.*nearest
resample(IMAGE, camera(), ico(), 2 * EYE) -> rotation: orthonormal
resample(IMAGE, camera(), ico(), torch.eye(4)) -> rotation: \(4, 4\)
resample(IMAGE, camera(), 5) -> target: Icosphere
resample(IMAGE, rig(), ico()) -> source: CameraRig
resample(torch.zeros(32, 40, 3), camera(), ico()) -> values: 32, 40
resample(IMAGE, camera(), ico(), mask=np.ones(SIZE)) -> mask: numpy
# geometry
bilinear_sample(ARRAY, torch.zeros(5, 2)) -> image: numpy
bilinear_sample(IMAGE, torch.zeros(5, 2).long()) -> pixels: int64
bilinear_sample(torch.zeros(2, 3, 4, 4), torch.zeros(3, 5, 2)) -> image and pixels: broadcast
normalize(INTEGERS) -> vectors: int64
angle_from_axis(INTEGERS) -> points: int64
directions_from_longitude_latitude(np.zeros(3), torch.zeros(3)) -> longitude: numpy
invert_transform(np.eye(4)) -> a_from_b: numpy
invert_transform(EYE) -> a_from_b: 4, 4
transform_points(torch.eye(4), INTEGERS) -> points: int64
transform_from_quaternion(torch.zeros(4), torch.zeros(3)) -> quaternion: zero
transform_from_axis_angle(INTEGERS, DIRECTIONS) -> axis_angle: int64
# icospheres and grids
Icosphere(-1) -> level: 0 .*10
Icosphere(30) -> level: ten million
Icosphere('5') -> level: '5'
Icosphere(2, torch.int64) -> dtype: floating
ico().sample(np.zeros((3, 162)), DIRECTIONS) -> values: numpy
ico().sample(LABELS, DIRECTIONS) -> values: int64
ico().sample(torch.zeros(3, 42), DIRECTIONS) -> values: level 2
ico().locate(POINTS) -> directions: numpy
icosphere_pool(np.zeros((3, 162))) -> values: numpy
icosphere_pool(torch.zeros(3, 100)) -> number of vertices: 642
level_from_num_vertices('many') -> number of vertices: 'many'
Equirectangular(4.5, 8) -> height: 4.5
Equirectangular(8, 16).sample(np.zeros((3, 8, 16)), DIRECTIONS) -> values: numpy
Equirectangular(8, 16).sample(torch.zeros(3, 8, 16), INTEGERS) -> directions: int64
Equirectangular(8, 16).sample(torch.zeros(3, 8, 16).byte(), DIRECTIONS) -> values: uint8
Cubemap(4).sample(torch.zeros(3, 6, 4, 4).byte(), DIRECTIONS) -> values: uint8
cube_pad(torch.zeros(1, 3, 5, 4, 4), 1) -> faces: 6, S, S
cube_pad(np.zeros((1, 3, 6, 4, 4)), 1) -> faces: numpy
cube_pad(torch.zeros(1, 3, 6, 4, 4), 9) -> padding: 9
equirectangular_pad(np.zeros((3, 8, 16)), 1) -> images: numpy
make_seamless(3) -> module: got 3
SphereConv2d(3, 4)(torch.zeros(1, 3, 8, 16, dtype=DOUBLE)) -> images: float32.*float64
SphereConv2d(-3, 4) -> in_channels: -3
# crowns
CrownConv2d(3, 4)(VALUES) -> crown: to_crown
CrownConv3d(3, 4)(VALUES) -> crown: to_crown
crown_relu(VALUES) -> crown: to_crown
exchange(VALUES) -> crown: to_crown
from_crown(VALUES) -> crown: to_crown
from_crown(crown(torch.uint8)) -> crown: uint8
crown_upsample(crown(torch.uint8)) -> crown: uint8
crown_max_pool2d(VALUES) -> crown: to_crown
CrownBatchNorm2d(3)(VALUES) -> crown: to_crown
CrownPointwise(torch.nn.ReLU())(VALUES) -> crown: to_crown
to_crown(VALUES[0]) -> values: \(B, C, V\)
to_crown(np.zeros((1, 3, 162))) -> values: numpy
CrownConv2d(3, 4)(crown(DOUBLE)) -> crown: float32.*\.to\(torch.float32
CrownConv3d(3, 4)(crown(DOUBLE, 4)) -> crown: float64
CrownConvNorm2d(3, 4)(crown(DOUBLE)) -> crown: float64
CrownConvNorm3d(3, 4)(crown(DOUBLE, 4)) -> crown: float64
CrownBatchNorm2d(3)(crown(DOUBLE)) -> crown: float64
CrownPointwise(torch.nn.Conv2d(3, 4, 1))(crown(DOUBLE)) -> crown: float64
HexConv2d(3, 4)(VALUES.double()) -> values: float64
HexConv3d(3, 4)(torch.zeros(1, 3, 4, 162).double()) -> values: float64
CrownConv2d(3, 4)(crown(torch.int64)) -> crown: int64
CrownConv2d(5, 4)(crown()) -> crown: 5 channels
CrownConv2d(3, 4)(crown(torch.float32, 4)) -> crown: to_crown
CrownConv2d(-3, 4) -> in_channels: -3
CrownConv2d(3, 4, stride=3) -> stride: 1 or 2
CrownConv2d(3, 4, 5) -> stride: got 5; a kernel is a vertex and its neighbours
CrownConv3d(3, 4, kernel_size=5) -> kernel_size: got 5; a kernel is a vertex and its neighbours
HexConv2d(3, 4, kernel_size=5) -> kernel_size: got 5; a kernel is a vertex and its neighbours
crown_conv2d(crown(), np.zeros((4, 3, 7))) -> weight: numpy
crown_conv2d(crown(), torch.zeros(4, 3, 7), torch.zeros(3)) -> bias: \(4,\)
HexConv2d(3, 4)(crown()) -> values: from_crown
crown() + VALUES -> crown: to_crown
crown() + to_crown(torch.zeros(1, 3, 42)) -> crown: col
# sweeps and networks
sweep()(np.zeros((1, 4, 5, 162)), rig()) -> features: numpy
sweep()(torch.zeros(1, 4, 5, 162).long(), rig()) -> features: int64
sweep()(torch.zeros(1, 3, 5, 162), rig()) -> features: rig.names
sweep()(torch.zeros(1, 4, 5, 42), rig()) -> features: 162
sweep()(torch.zeros(1, 1, 5, 162), [camera()]) -> rig: CameraRig, got list
sweep()(torch.zeros(1, 1, 5, 162), camera()) -> rig: FisheyeCamera
PanoramaSweep((8, 16), 8, 0.5).tables(camera()) -> rig: FisheyeCamera
sweep()(torch.zeros(1, 4, 5, 162), rig(), torch.ones(4, 162)) -> seen: bool
sweep()(torch.zeros(1, 4, 5, 162), rig(), np.ones((4, 162))) -> seen: numpy
SphereSweep(2, 1, 0.5) -> num_hypotheses: 2 or more
SphereSweep(2, 8.5, 0.5) -> num_hypotheses: 8.5
SphereSweep(2, 10 ** 9, 0.5) -> num_hypotheses: 4096
SphereSweep(2, 8, 0.0) -> min_depth: positive
SphereSweep(2, 8, NAN) -> min_depth: nan
SphereSweep(2, 8, 'near') -> min_depth: 'near'
depth_from_index(np.zeros(3), 8, 0.5) -> index: numpy
index_from_depth(torch.ones(3).long(), 8, 0.5) -> depth: int64
soft_argmax(np.zeros((8, 162))) -> logits: numpy
soft_argmax(torch.zeros(8, 162).long()) -> logits: int64
net()(np.zeros((1, 4, 3, 2562)), rig()) -> images: numpy
net()(torch.zeros(1, 4, 3, 2562).double(), rig()) -> images: float64
net()(torch.zeros(1, 4, 3, 2562).byte(), rig()) -> images: uint8
net()(torch.zeros(1, 4, 3, 162), rig()) -> images: level 4
net()(torch.zeros(1, 3, 3, 2562), rig().subset([0, 1, 2])) -> images: 4 cameras
net()(torch.zeros(1, 4, 3, 2562), None) -> rig: got None
SemiGlobalSweep(3, 8, 0.5)(np.zeros((1, 4, 3, 642)), rig()) -> images: numpy
pretrained('resnet') -> name: refinedsweepnet
# losses and metrics
depth_index_huber(np.zeros((1, 5)), torch.zeros(1, 5)) -> pred_index: numpy
depth_index_huber(torch.zeros(1, 5), torch.zeros(1, 5), delta=-1.0) -> delta: -1.0
solid_angle_mean(np.zeros((1, 162)), ico().solid_angles) -> values: numpy
solid_angle_mean(LABELS, ico().solid_angles) -> values: int64
DepthIndexError(8).update(np.zeros((1, 3)), torch.zeros(1, 3)) -> pred: numpy
DepthError().update(torch.ones(1, 3), np.ones((1, 3))) -> target: numpy
SolidAngleMean(3) -> grid: SphereGrid, got 3
angular_error(INTEGERS, DIRECTIONS) -> pred: int64
# scenes and samples
make_scene('room', seed='a') -> seed: 'a'
make_scene('moon') -> kind: 'room'
render_rig(None, rig()) -> scene: make_scene
render_rig(make_scene('bare'), camera()) -> rig: FisheyeCamera
render_directions(make_scene('bare'), torch.zeros(3), POINTS) -> directions: numpy
collate_samples([3]) -> samples: got 3
random_rotations(-1) -> count: -1
Compose([max, min]) -> transforms: takes no list
# pictures and points
save_point_cloud('x.ply', POINTS, torch.zeros(5, 3)) -> points: numpy
save_point_cloud('x.doc', DIRECTIONS, DIRECTIONS) -> path: '.ply'
icosphere_mesh(5) -> depth: got int
sphere_mesh(ico()) -> values: Icosphere
# depth of a rig
Predictor(rig().subset(['cam1']), min_depth=0.5) -> rig: two or more.*\(cam1\)
Predictor(CameraRig([camera()] * 2, EYES.repeat(2, 1, 1)), min_depth=0.5) -> rig: one place
Predictor(camera()) -> rig: FisheyeCamera
Predictor(rig(), method='semi_global', level=50) -> level: 50
Predictor(rig(), device='gpu') -> device: 'cpu'
Predictor(rig(), method='magic') -> method: 'semi_global'
Predictor(rig(), num_hypotheses=-1) -> num_hypotheses: -1
sees(3) -> images: got int
sees(pictures('a.png')) -> images.*cam1: uint8
sees({'cam1': torch.zeros(3, 24, 24)}) -> images: cam2
sees(pictures(torch.zeros(3, 5, 24))) -> cam1: 24 x 24
sees(pictures(torch.full((3, 24, 24), 200.0))) -> cam1: 200
sees(pictures(torch.full((3, 24, 24), NAN))) -> cam1: nan|NaN|finite
# sphere: cubemap
cube_to_layout(torch.zeros(5, 4, 4)) -> values: expected a cube map \(\*, 6, s, s\), got \(5, 4, 4\)
cube_to_layout(torch.zeros(6, 4, 4), 'cross') -> layout: expected one of 'dice', 'strip', 'list', 'dict'
cube_from_layout(torch.zeros(3, 10, 12), 'dice') -> faces: expected one picture .* got \(3, 10, 12\)
cube_from_layout({'front': torch.zeros(4, 4)}, 'dict') -> faces: keys front, right
Cubemap(0) -> size: expected a whole number of 1 or more, got 0
Cubemap(128, 128) -> dtype: got 128; this grid is 6×128×128
# sphere: equirectangular
Equirectangular(4, 0) -> width: expected a whole number of 1 or more, got 0
# sphere: healpix
Healpix(3, nested=True) -> nside: nested order needs a power of two
Healpix(0) -> nside: expected a whole number of 1 or more, got 0
Healpix(2).sample(torch.zeros(1, 50), torch.ones(1, 3)) -> values: expected shape \(\*b, c, 48\), got \(1, 50\)
Healpix(2).locate(torch.ones(1, 3), 'rings') -> interpolation: expected one of 'healpy', 'chords'
healpix_pool(torch.ones(108)) -> values: pixels nest for nside 1, 2, 4, 8, \.\.\., got nside 3
healpix_pool(torch.ones(12)) -> values: expected nside 2 or more to pool, got 1
healpix_upsample(torch.ones(13)) -> values: expected shape \(\*, 12 \* nside\*\*2\), got \(13,\)
# sphere: latitudes
Equirectangular.with_square_pixels(5, 8) -> height, width: at most half the width
Equirectangular(4, 8, max_latitude=45.0) -> max_latitude: expected radians
EquirectangularCamera((4, 8), 1.0, latitudes=(0, 0.5)) -> vertical_field_of_view, latitudes: expected one
# sphere: padding
equirectangular_pad(torch.zeros(2, 4), 3) -> padding: expected at most the size 2 x 4
EquirectangularPad2d(-1) -> padding: expected pixels on all sides
equirectangular_pad(torch.zeros(4), 1) -> images: expected
cube_pad(torch.zeros(5, 3, 4, 4), 1) -> faces: expected shape \(B, C, 6, S, S\)
CubePad2d(5)(torch.zeros(6, 3, 4, 4)) -> padding: expected at most the size 4
# sphere: resample
resample(torch.zeros(1, 43), Icosphere(1), Equirectangular(4, 8)) -> values: expected shape \(\*b, c, 42\)
resample(torch.zeros(1, 42), Icosphere(1), 'panorama') -> target: expected a SphereGrid .* or a Camera, got str
resample(torch.zeros(1, 42), Icosphere(1), Equirectangular(4, 8), torch.eye(4)) -> rotation: expected shape \(3, 3\)
# sphere: resample module
Resample(Cubemap(4), Healpix(1), mode='bicubic') -> mode: expected one of 'bilinear', 'nearest', 'area'
Resample(Cubemap(4), 'cube') -> target: expected a SphereGrid
# sphere: sphere conv
SphereConv2d(3, 8, 4) -> kernel_size: expected odd sizes
SphereConv2d(3, 8, 5)(torch.zeros(1, 3, 4, 8)) -> kernel_size: reaches 90°
sphere_taps((8, 16), stride=(0, 1)) -> stride: expected positive
# sphere: tangent
TangentImages(0, 5, margin=2) -> size: expected more than 5 pixels for a face and its margin of 2
TangentImages(-1, 5) -> level: expected an integer from 0
# icosphere: adjacency
icosphere_within(torch.ones(3), -0.1, 2) -> angle: expected 0 to π
icosphere_rings(1, 1, torch.tensor([42])) -> centers: 0 to 41
# icosphere: areas
icosphere_normals(torch.ones(43, 3)) -> number of vertices: got 43
# icosphere: levels
icosphere_pool(torch.ones(42), 'median') -> mode: 'mean', 'max'
icosphere_pool(torch.ones(12)) -> level: no coarser level
icosphere_pool(LABELS) -> values: int64
icosphere_upsample(torch.ones(43)) -> number of vertices: got 43
icosphere_upsample(LABELS) -> values: int64
IcosphereUpsample(2)(LABELS.byte()) -> values: uint8
IcospherePool(2)(torch.ones(1, 42)) -> values: level 2, got \(1, 42\)
# icosphere: locate
Icosphere(1).locate(torch.zeros(4, 2)) -> directions: expected shape \(\*, 3\)
Icosphere(1).locate(torch.zeros(4, 3, dtype=torch.long)) -> directions: floating point
Icosphere(1).sample(torch.zeros(1, 12), torch.ones(4, 3)) -> values: expected shape \(\*b, c, 42\).*level 1
Icosphere(1).sample(torch.zeros(1, 42), torch.ones(3)) -> directions: \(\*b, n, 3\)
# icosphere: topology
Icosphere(0).coarser() -> Icosphere\.coarser: level 0
# crown: hexconv
HexConv2d(4, 5)(torch.zeros(1, 3, 42)) -> values: expected 4 channels
hex_conv2d(torch.zeros(1, 3, 42), torch.zeros(5, 3, 9)) -> weight: 7\), got \(5, 3, 9\)
HexConv3d(3, 5)(torch.zeros(1, 3, 42)) -> values: N, V\), got \(1, 3, 42\)
HexConv2d(3, 5, orientation='north', level=2)(torch.zeros(1, 3, 42)) -> values: level 2.*got level 1
HexConv2d(3, 5, orientation='north') -> level: expected the level
HexConv2d(3, 5, orientation='south') -> orientation: expected one of 'chart', 'north'
HexConv2d(3, 5, stride=3) -> stride: expected 1
HexConv2d(3, 5, stride=2)(torch.zeros(1, 3, 12)) -> stride: at level 0
# crown: layers
CrownConv2d(4, 5)(to_crown(torch.zeros(1, 3, 42))) -> crown: expected 4 channels
crown_conv2d(to_crown(torch.zeros(1, 3, 42)), torch.zeros(5, 3, 9)) -> weight: 7\), got \(5, 3, 9\)
CrownConv3d(3, 5)(to_crown(torch.zeros(1, 3, 42))) -> crown: \(B, 5, C, N, 2n \+ 1, n \+ 1\)
CrownConv2d(3, 5, stride=3) -> stride: expected 1
CrownConv2d(3, 5, stride=2)(to_crown(torch.zeros(1, 3, 12))) -> stride: at level 0
CrownBatchNorm2d(4)(to_crown(torch.zeros(1, 3, 42))) -> crown: expected 4 channels
CrownAvgPool2d()(to_crown(torch.zeros(1, 3, 12))) -> stride: at level 0
# crown: layout
to_crown(torch.zeros(1, 1, 13)) -> number of vertices: 2 \+ 10 \* 4\*\*level.*got 13
to_crown(torch.zeros(12)) -> values: \(B, C, V\) or \(B, C, N, V\), got \(12,\)
# crown: sequential
CrownMaxPool2d()(to_crown(torch.zeros(1, 3, 12))) -> stride: at level 0
CrownMaxPool2d()(to_crown(torch.zeros(1, 3, 4, 42))) -> crown: expected
# sweep: photo consistency
photo_consistency(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, level=4) -> level: level
# sweep: semi global
semi_global_sweep(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, cost_level=4) -> level, cost_level: cost_level
# sweep: smoothing
semi_global_smoothing(torch.zeros(1, 4, 42), 0.5, 0.1) -> small_penalty, large_penalty: P1 <= P2
# sweep: sphere sweep
SphereSweep(2, 4, 0.5)(torch.zeros(1, 4, 2, 642), ring_rig(4)) -> features: level 2
SphereSweep(2, 4, 0.5)(torch.zeros(1, 3, 2, 162), ring_rig(4)) -> features: 3 cameras.*rig has 4
# metrics: evaluation masks
seen_by(ring_rig(4), torch.tensor([[0.0, -1.0, 0.0]]), torch.zeros(2)) -> inverse_depth: expected \(\*b, 1\)
seen_by(ring_rig(4), torch.tensor([[0.0, -1.0, 0.0]]), -torch.ones(1)) -> inverse_depth: 0 or more, got -1
seam_mask(torch.tensor([[0.0, -1.0, 0.0]]), seams='cube') -> seams: 'charts', 'panorama', got 'cube'
omnimvs_error(torch.zeros(1, 8, 24), torch.zeros(1, 8, 24)) -> prediction: w = 4h
# metrics: sphere metrics
SolidAngleMean(Equirectangular(4, 8)).update(torch.zeros(1, 8, 4)) -> values: expected shape \(B, 4, 8\)
solid_angle_mean(torch.zeros(8, 4), Equirectangular(4, 8).solid_angles) -> values: expected
solid_angle_mean(torch.zeros(4, 8), Equirectangular(4, 8).solid_angles, torch.ones(3, 8)) -> mask: expected
# models: network aggregation
IcoSweepNet(3, feature_coarsening=3) -> coarsening: expected 1 or 2
# models: refinedsweepnet
RefinedSweepNet(level=4) -> level: level
# models: weights
pretrained('nonesuch') -> name: 'nonesuch'
# data: collate
collate_samples([{'a': 1}, {'b': 2}]) -> samples: same keys
collate_samples([]) -> samples: at least one
# data: sphere transforms
RandomYaw(Icosphere(1), p=2.0) -> p: expected a probability
RandomYaw(Icosphere(1), angles='exact') -> angles: 'grid', 'any'
RandomYaw(Icosphere(1))({'colour': torch.rand(1, 42)}) -> sample: one of image
RandomYaw(Icosphere(1)).inverse(torch.rand(1, 3, 42)) -> params: nothing was turned yet
# viz: cameras picture
angle_map(PinholeCamera([200.0, 200.0], [99.5, 99.5], (200, 200)), torch.zeros(3, 100, 200)) -> image: 200 x 200
# viz: color
error_to_color(torch.ones(2), 0.0) -> max_error: expected a positive number
# viz: crown picture
# viz: figure
sheet([np.zeros((2, 2, 3))]) -> picture: uint8 \(h, w, 3\), got float64
sheet([]) -> sheet: at least one column
# viz: mesh
sphere_mesh(torch.ones(2, 42)) -> values: colours \(3, V\)
icosphere_mesh(torch.ones(42), max_jump=0.9) -> max_jump: above 1
icosphere_mesh(torch.ones(42), torch.ones(42, 3)) -> colors: expected \(3, 42\)
# geometry: interpolation
bilinear_sample(torch.zeros(1, 2, 2, dtype=torch.uint8), torch.zeros(1, 2)) -> image: uint8.*convert
# cameras: coverage
coverage(ring_rig(3), torch.ones(2, 2, 3), [1.0]) -> directions: flatten the grid
# cameras: kornia
to_kornia(PinholeCamera([500.0, 510.0], [319.5, 239.5], (480, 640), skew=2.5)) -> camera: PINHOLE has no skew
# cameras: models
PinholeCamera([1.0, 1.0], [0.0, 0.0], (10.5, 20)) -> image_size: expected \(height, width\)
# sphere: sphere conv
SphereConv2d(3, 8)(torch.zeros(1, 4, 8, 16)) -> images and weight: got \(1, 4, 8, 16\)
# icosphere: adjacency
icosphere_within(torch.ones(2), 0.1, 2) -> directions: got \(2,\)
icosphere_rings(1, -1) -> num_rings: got -1
icosphere_edges(-1) -> level: got -1
# icosphere: areas
icosphere_normals(torch.ones(42, 2)) -> points: got \(42, 2\)
# crown: hexconv
HexConv2d(3, 5)(torch.zeros(1, 3, 43)) -> number of vertices: got 43
# sweep: photo consistency
photo_consistency(torch.zeros(2, 3, 642), ring_rig(2), 8, 0.5) -> sphere_images: got \(2, 3, 642\)
photo_consistency(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, aggregation=-1) -> aggregation: got -1
# sweep: regression
soft_argmax(torch.zeros(8)) -> logits: got \(8,\)
# sweep: semi global
semi_global_sweep(torch.zeros(1, 2, 3, 642)[0], ring_rig(2), 8, 0.5) -> sphere_images: got \(2, 3, 642\)
semi_global_sweep(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, substeps=0) -> substeps: got 0
semi_global_sweep(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, level=11) -> level: got 11
# sweep: smoothing
semi_global_smoothing(torch.zeros(1, 4, 42)[0], 0.1, 0.5) -> cost: got \(4, 42\)
semi_global_smoothing(torch.zeros(1, 4, 42), 0.1, 0.5, torch.zeros(1, 3, 162)) -> guide: got \(1, 3, 162\)
semi_global_smoothing(torch.zeros(1, 4, 42), 0.1, 0.5, contrast=0.0) -> contrast: got 0\.0
semi_global_smoothing(torch.zeros(1, 4, 42), 0.1, 0.5, lead=5.0) -> lead: got 5\.0
# sweep: sphere sweep
SphereSweep(-1, 4, 0.5) -> level: got -1
# metrics: depth errors
DepthIndexError(0) -> num_hypotheses: got 0
DepthError(max_depth=0.0) -> max_depth: got 0\.0
DepthIndexError(8).update(torch.zeros(1, 5), torch.zeros(1, 6)) -> target: got \(1, 6\)
DepthIndexError(8).update(torch.zeros(1, 5), torch.zeros(1, 5), torch.ones(5, dtype=torch.bool)) -> mask: got \(5,\)
DepthIndexError(8).update(torch.zeros(1, 5), torch.zeros(1, 5), weights=torch.ones(4)) -> weights: got \(4,\)
# metrics: evaluation masks
evaluation_mask(ring_rig(4), torch.tensor([[0.0, -1.0, 0.0]]), torch.zeros(1)) -> inverse_depth: got \(1,\)
seam_mask(torch.tensor([[0.0, -1.0, 0.0]]), 0.0) -> angle: got 0\.0
omnimvs_error(torch.zeros(1, 8, 16), torch.zeros(1, 8)) -> target: got \(1, 8\)
OmniMVSError(min_depth=0.0) -> min_depth, num_hypotheses: got 0\.0
ByRegion(DepthIndexError(8), {}) -> regions: got none
# metrics: sphere metrics
SolidAngleMean(Equirectangular(4, 8)).update(torch.zeros(2, 4, 8), torch.ones(1, 4, 8)) -> mask: got \(1, 4, 8\)
depth_index_huber(torch.zeros(1, 5), torch.zeros(1, 5), weights=torch.ones(4)) -> weights: got \(4,\)
# losses: losses
depth_index_huber(torch.zeros(2, 5), torch.zeros(2, 1, 5)) -> target_index: got \(2, 1, 5\)
depth_index_huber(torch.zeros(2, 5), torch.zeros(2, 5), torch.ones(5, dtype=torch.bool)) -> mask: got \(5,\)
# models: network aggregation
IcoSweepNet(3, volume_channels=0) -> feature_channels, volume_channels: got 32
# models: refinedsweepnet
RefinedSweepNet.around(torch.nn.Identity()) -> prior: got Identity
# data: sphere transforms
RandomSphereRotation(Icosphere(1), max_angle=0.0) -> max_angle: got 0\.0
# scenes: scenes
make_scene(scale=0.0) -> scale: got 0\.0
make_scene(clear_radius=2.0) -> clear_radius: got 2\.0
# geometry: directions
angle_from_axis(torch.zeros(3, 2)) -> points: got \(3, 2\)
# geometry: transforms
invert_transform(torch.eye(3)) -> a_from_b: got \(3, 3\)
# cameras: coverage
coverage(ring_rig(3), torch.eye(3), [1.0, 0.0]) -> depths: expected
overlap(torch.ones(2, 4), torch.ones(3)) -> solid_angles: got shape \(3,\)
# capture: preparation
Preparation(photometric='yes') -> photometric: expected
# sphere: resample
resample(VALUES, ico(), Equirectangular(4, 8), mode='cubic') -> mode: expected one of 'bilinear', 'nearest'
resample(torch.zeros(1, 6, 4, 4).long(), Cubemap(4), Healpix(1)) -> values: floating point .* for mode 'bilinear'
resample(torch.zeros(1, 6, 4, 4), Cubemap(4), ico(), mask=torch.ones(4, 4)) -> mask: \(\*b, 6, 4, 4\) as the source
# sphere: grids
Cubemap(4).sample(torch.zeros(6, 4, 4), DIRECTIONS) -> values: expected shape \(\*b, c, 6, 4, 4\), got \(6, 4, 4\)
Equirectangular(4, 8).sample(torch.zeros(3, 8, 4), DIRECTIONS) -> values: \(\*b, c, 4, 8\), got \(3, 8, 4\)
Equirectangular.with_square_pixels(2, 8).sample(torch.zeros(1, 8, 2), DIRECTIONS) -> values: \(\*b, c, 2, 8\)
Equirectangular.with_square_pixels(2, 8).rows_of(torch.zeros(3, 8)) -> \(2, 8\) or \(4, 8\): whole sphere, got \(3, 8\)
Equirectangular(4, 8, latitudes=(0.5, -0.5)) -> latitudes: got
Equirectangular(4, 8, latitudes=(0, 2)) -> latitudes: got
Equirectangular(4, 8, longitudes=(0, 7)) -> longitudes: got
Equirectangular(4, 8, longitudes=3) -> longitudes: got .* and 3
EquirectangularCamera((4, 8), latitudes=(0.5, -0.5)) -> latitudes: got
EquirectangularCamera((4, 8), latitudes=(0, 2)) -> latitudes: got
EquirectangularCamera((4, 8), longitudes=(0, 7)) -> longitudes: got
EquirectangularCamera((4, 8), longitudes=3) -> longitudes: got .* and 3
# sphere: padding
make_seamless(torch.nn.Sequential(torch.nn.ReLU(), torch.nn.ConvTranspose2d(1, 1, 3))) -> module: 1 is ConvTranspose2d
make_seamless(torch.nn.Upsample(scale_factor=2, mode='bilinear')) -> module: Upsample
# icosphere
Icosphere(1.5) -> level: expected an integer
Icosphere(True) -> level: expected an integer
TriangleLocator(-1) -> level: expected an integer from 0
TriangleLocator(11) -> level: expected an integer from 0
# sweep
inverse_depth_hypotheses(2.5, 0.5) -> num_hypotheses: got 2\.5
inverse_depth_hypotheses(8, 5e-324) -> min_depth: 5e-324
inverse_depth_hypotheses(8, 1e10) -> min_depth: got 10000000000
semi_global_sweep(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, small_penalty=5.0) -> small_penalty: P1 <= P2
semi_global_sweep(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, seen=torch.ones(3, 642) > 0) -> seen: got \(3, 642\)
sweep()(torch.zeros(3, 4, 2, 162), CameraRig.stack([rig(), rig()])) -> rig: one rig for each of 3 samples.*got 2
PanoramaSweep((4, 8), 4, 0.5)(torch.zeros(1, 4, 3, 24, 24), rig()) -> \(B, n, C, 12, 12\): images of 24 x 24 pixels
PanoramaSweep((4, 8), 4, 0.5)(torch.zeros(1, 3, 3, 12, 12), rig()) -> 3 cameras: rig has 4
PanoramaSweep((4, 8), 4, 0.5)(torch.zeros(3, 4, 3, 12, 12), CameraRig.stack([rig(), rig()])) -> rig: got 2 rigs
PanoramaSweep((4, 8), 4, 0.5).tables(rig().resized({'cam1': (10, 10)})) -> images of one size: \(10, 10\), \(24, 24\)
photo_consistency_share(torch.zeros(2, 642), torch.zeros(1, 4, 3, 10242), rig(), 9, 0.5) -> index: expected shape
sweep()(torch.zeros(1, 4, 5, 162), SphereSweep(3, 8, 0.5).tables(rig())) -> rig: 162 vertices.*got 8 at 642
sweep()(torch.zeros(1, 4, 5, 162), SphereSweep(2, 9, 0.5).tables(rig())) -> rig: 8 hypotheses.*got 9 at 162
semi_global_sweep(IMAGES, semi_global_tables(rig(), 8, 0.5, 2), 8, 0.5, seen=SEEN) -> rig: 642 vertices, got.*162
photo_consistency_share(torch.zeros(1, 42), IMAGES, semi_global_tables(rig(), 9, 0.5, 2), 9, 0.5, SEEN) -> rig: 642
semi_global_sweep(IMAGES, rig(), 8, 0.5, seen=SEEN.byte()) -> seen: expected bool.*uint8
photo_consistency(IMAGES, rig(), 8, 0.5, seen=SEEN.float()) -> seen: expected bool.*float32
semi_global_sweep(IMAGES.byte(), rig(), 8, 0.5) -> sphere_images: uint8
photo_consistency(IMAGES.byte(), rig(), 8, 0.5) -> sphere_images: uint8
PanoramaSweep((4, 8), 4, 0.5).tables_for(VIEWS, PanoramaSweep((8, 16), 4, 0.5).tables(rig())) -> rig: \(2, 4, 8\)
# models
IcoSweepNet(3, aggregation='median') -> aggregation: 'variance'
IcoSweepNet(30) -> level: expected an integer from 0
IcoSweepNet(1) -> level: got 1
IcoSweepNet(3, 1) -> num_hypotheses: got 1
IcoSweepNet(3, min_depth=-1.0) -> min_depth: got -1
IcoSweepNet(3, num_cameras=0) -> num_cameras: got 0
net()(torch.zeros(1, 4, 3, 2562), ring_rig(3)) -> 4 cameras: the rig has 3
OmniMVS(output_size=(160, 600)) -> output_size: multiples of 32.*got \[160, 600\]
OmniMVS(output_size=(33, 64)) -> output_size: 33
OmniMVS(output_size=(64, 64)) -> height, width: at most half the width
OmniMVS(15) -> num_hypotheses: expected an even number.*got 15
OmniMVS(8, in_channels=2) -> in_channels: expected 1 \(grey\) or 3
OmniMVS(8, aggregation='sum') -> aggregation: 'sum'
OmniMVS(8, norm='layer') -> norm: 'layer'
OmniMVS(8, num_scales=0) -> num_scales: got 32 and 0
# metrics
evaluation_mask(rig(), DIRECTIONS, torch.zeros(1, 1), least_cameras=0) -> least_cameras: got 0
evaluation_mask(rig(), DIRECTIONS, torch.zeros(1, 1), torch.ones(2, 1)) -> valid: got \(2, 1\)
OmniMVSError().update(torch.zeros(1, 8, 16), torch.zeros(1, 8, 16), weights=torch.ones(128)) -> weights: every pixel
ByRegion(DepthIndexError(8), {'seam': torch.ones(3)}).update(torch.zeros(1, 4), torch.zeros(1, 4)) -> region 'seam': got
SolidAngleIoU(ico(), 2).update(LABELS, LABELS + 7) -> target: labels from 0 to 1, got 7 to 7
# data
RandomYaw(Icosphere(1), kinds={'flow': 'vectors'}) -> kind: 'image', 'depth', 'normals', 'labels', 'seen', 'rig'
RandomYaw(Icosphere(1))({'image': torch.rand(2, 3, 42), 'depth': torch.rand(42)}) -> depth: values: .*same_on_batch
RotateFisheye(mode='depth') -> mode: 'area' or 'bilinear'
RotateFisheye(rotation=torch.eye(4)) -> rotation: got \(4, 4\)
# scenes
World(rig(), kind='street') -> kind: 'street'
WorldSamples(World(rig()), SampleView(1), range(0)) -> seeds: expected one or more
WorldSamples(World(rig()), SampleView(1), range(-1, 1)) -> seeds: from 0
WorldSamples(World(rig()), SampleView(1), range(10_000_000, 10_000_001)) -> seeds: held out
SampleView(-1) -> level: got -1
World(rig(), min_depth=0.0) -> min_depth: got 0
WorldSamples(World(ring_rig(4, 1.2)), SampleView(1), range(1)) -> rig: min_depth above 1\.10
World(rig(), tilts=(0.4, 0.1)) -> tilts: got
World(rig(), tilts=(-0.3, 0.8), carrier='pole') -> tilts: no carrier
SampleView() -> view: got none
SampleView(panorama=(10, 30)) -> panorama: height 10, width 30
WorldSamples(World(rig().resized({'cam1': (20, 20)})), SampleView(images=True), range(1))[0] -> one size: resized
render_camera(make_scene(), camera(), torch.eye(4), samples_per_pixel=0) -> samples_per_pixel: got 0
# cameras: what models are made of
UnifiedCamera(F, C, 1.0, [0.0] * 3, SIZE) -> distortion: expected \(\*, 5\) .* got shape \(3,\)
ExtendedUnifiedCamera(F, C, 1.5, 1.0, SIZE) -> alpha: expected numbers in \[0, 1\], got 1.5
ExtendedUnifiedCamera(F, C, 0.5, 0.0, SIZE) -> beta: expected numbers above 0, got 0.0
AtanCamera(F, C, 3.2, SIZE) -> omega: expected radians in \(0, π\)
ThinPrismFisheyeCamera(F, C, [0.0] * 6, [0.0] * 2, [0.0] * 4, SIZE, composition='both') -> composition: 'sequential'
ThinPrismFisheyeCamera(F, C, [0.0] * 6, [0.0] * 2, [0.0] * 2, SIZE) -> thin_prism: expected shape \(\*, 4\), got \(2,\)
OCamCamera([100.0, 0.0, 1e-3], None, C, [1, 0, 0], SIZE, 1.0) -> polynomial: the first coefficient .* negative
OCamCamera([-9.0, 0.0, 0.01], None, C, [1, 1, 1], SIZE, 1.0) -> affine: got
OCamCamera([-9.0, 0.0, 0.01], None, C, [1, 0, 0], SIZE, 110) -> max_angle: radians
RadialPolynomialCamera([-1.0, 2.0], C, 1.0, SIZE) -> polynomial: the first above 0, got \[-1.0, 2.0\]
RadialPolynomialCamera([9.0], C, 0.0, SIZE) -> aspect_ratio: expected numbers above 0, got 0.0
BrownConradyCamera(F, C, [0.0] * 6, SIZE) -> distortion: got shape \(6,\); fill up with zeros
FisheyeCamera.from_field_of_view(SIZE, 3.84, 'orthographic') -> field_of_view: up to 180° .* orthographic lens, got 220
PinholeCamera(torch.ones(3, 2), torch.ones(2, 2), SIZE) -> focal_length \(3, 2\), principal_point: \(2, 2\)
FisheyeCamera.stack([camera()] * 3).project(torch.zeros(2, 7, 3)) -> batch shape: expects \(3, \*, 3\), got \(2, 7, 3\)
# cameras: rig, remap
rig().project(DIRECTIONS[0]) -> points: expected \(P, 3\)
rig().points_seen(torch.ones(2, 2, 3), torch.zeros(1)) -> directions: flatten the grid
rig().points_seen(DIRECTIONS, torch.zeros(2, 5)) -> inverse_depths: expected \(N,\) or \(\*b, N, 1\)
rig().points_seen(DIRECTIONS, torch.tensor([1.0, -1.0])) -> inverse_depths: expected 1/m, 0
remap(torch.zeros(3, 40, 32), camera(), camera()) -> image: 32 x 40 \(height x width\), got shape \(3, 40, 32\)
Remap(camera(), camera())(IMAGE[0]) -> image: 32 x 40
remap(IMAGE, camera(), camera(), mask=torch.ones(60, 80)) -> mask: expected shape \(\*b, 32, 40\)
remap(IMAGE, camera(), camera(), torch.eye(4)) -> rotation: expected shape \(3, 3\) or \(\*b, 3, 3\)
remap(BYTES, camera(), camera(), mode='nearest', fill=-1) -> fill: torch.uint8 can hold, got -1
remap(IMAGE, camera(), camera(), mode='bicubic', mask=torch.ones(SIZE)) -> mask: bicubic kernel has negative weights
# sphere: sizes
Equirectangular(10**7, 2 * 10**7) -> height, width: expected
Equirectangular.with_square_pixels(10**6, 10**7) -> height, width: expected
Cubemap(10**6) -> size: expected
Healpix(2**20) -> nside: expected
TangentImages(3, 10**6) -> base_level, size: expected
TangentImages(40, 8) -> level: expected
# pictures, crowns, captures
depth_panorama(torch.ones(1, 4, 8), 0.5) -> depth: a panorama \(H, W\), got \(1, 4, 8\)
rgb_panorama(rig(), {}, 16) -> images: expected those of the cameras
rgb_panorama(rig(), pictures(torch.zeros(3, 24, 24)), 16, torch.ones(8, 16)) -> depth: \(16, 32\) or a number
save_point_cloud('x.ply', torch.zeros(4, 3), torch.zeros(5, 3)) -> points: \(n, 3\) both
save_point_cloud('x.ply', torch.tensor([[NAN, 0.0, 0.0]]), torch.zeros(1, 3)) -> points: 1 of them not finite
from_crown(Crown(crown().row, crown().col)) -> crown: make it with to_crown
from_crown(Crown(crown().col, crown().row.expand(2, -1, -1, -1, -1))) -> crown: col \(1, 5, 3, 9, 5\) and row \(2, 5
calibrate_photometry(rig(), {'cam1': IMAGE}) -> images: expected one for each of cam1, cam2, cam3, cam4, got cam1
calibrate_photometry(rig(), pictures(torch.zeros(3, 24, 24)), depth=-1) -> depth: metres above 0, got -1
calibrate_photometry(rig(), pictures(torch.zeros(3, 8, 8))) -> images\['cam1'\]: 24 x 24
find_own_body(rig(), [{'cam1': torch.zeros(3, 24, 24)}]) -> frames: one for each of cam1, cam2, cam3, cam4, got cam1
find_own_body(rig(), [pictures(torch.zeros(3, 8, 8))]) -> frames\['cam1'\]: 24 x 24
find_own_body(rig(), [], margin=-1) -> margin: -1
# models, data, metrics, scenes
RomniStereo(16, output_size=(15, 64)) -> output_size: 15
RomniStereo(14) -> num_hypotheses: 14
RomniStereo(17) -> num_hypotheses: 17
RomniStereo(16, iterations=0) -> iterations: 0
RomniStereo(16, in_channels=2) -> in_channels: 2
collate_samples([{'images': {'a': IMAGE}}, {'images': {'a': IMAGE[:, 1:]}}]) -> images\.a: of one shape .*ToSphere
left_right_error(torch.ones(2, 3), torch.ones(2, 3)) -> pred, target: expected
# cameras: poses, images of a rig, rectified pairs
CameraRig([camera()] * 4, EYES.repeat(3, 1, 1)) -> 4 cameras: got \(3, 4, 4\)
sample_sphere(rig(), [torch.zeros(3, 24, 24)] * 3, DIRECTIONS) -> images: expected 4, one for each camera, got 3
sample_sphere(rig(), {'a': IMAGE, 'b': IMAGE}, DIRECTIONS) -> images: cam1, cam2, cam3, cam4, got a, b
sample_sphere(rig(), [torch.zeros(3, 12, 24)] * 4, DIRECTIONS) -> images\['cam1'\]: 24 x 24.*got shape \(3, 12, 24\)
rectified_pairs(rig(), pairs=[('cam1', 'left')]) -> cameras: expected names among cam1
rectified_pairs(at_once(), pairs=[('cam1', 'cam2')]) -> stand in: one place
rectified_pairs(at_once()) -> no two: of the cameras cam1
rectified_pairs(rig().subset([0])) -> no two: of the cameras cam1
rectified_pairs(CameraRig([pinhole()] * 2, ring_rig(2).world_from_camera), pairs=[('cam1', 'cam2')]) -> share: no field
rectified_pairs(CameraRig.stack([rig(), rig()])) -> single: rig
rectified_pairs(rig())[0].distance(torch.zeros(4, 4)) -> disparity: this camera's images
rectified_pairs(rig())[0].distance(torch.zeros(rectified_pairs(rig())[0].image_size), 'cam9') -> of: cam1
rectified_pairs(rig())[0].rectify({'cam1': IMAGE}) -> images: expected one for each of
# capture: a predictor, turns of cameras
sees(blank() | {'left': IMAGE}) -> left: are no cameras
sees(blank() | {'cam3': torch.zeros(1, 3, 24, 24)}) -> images: equally many
sees(pictures(torch.zeros(24, 24, dtype=torch.int64))) -> images: int64
Predictor(rig().subset([0, 1, 2]), net()) -> it has: 3 cameras
align_rig_direct(rig().subset([0]), {'cam1': torch.zeros(3, 24, 24)}, DIRECTIONS, torch.ones(1)) -> rig: two or more
align_rig_direct(rig(), {'cam1': IMAGE}, DIRECTIONS, torch.ones(1)) -> images: one for each of cam1, cam2
align_rig_direct(rig(), blank(), DIRECTIONS, torch.ones(7)) -> inverse_depth: expected shape \(\[F,\] 1\), got \(7,\)
align_rig_direct(rig(), blank(), DIRECTIONS, torch.ones(1), torch.ones(7)) -> weights: expected shape \(1,\)
align_rig_direct(rig(), blank(), DIRECTIONS, torch.ones(2, 1)) -> images\['cam1'\]: expected shape \(2, c, 24, 24\)
align_rig_direct(rig(), blank(), DIRECTIONS, torch.ones(1), iterations=0) -> iterations: more than 0, got 0
align_rig_direct(rig(), blank(), DIRECTIONS[None], torch.ones(1)) -> directions: \(V, 3\)
align_rig_direct(at_once(), blank(), DIRECTIONS, torch.ones(1)) -> rig: one place
"""
"""The call -> the argument that the message names: a further word of it, both as regular expressions."""

ROOMS = (
    "cameras",
    "capture",
    "crown",
    "data",
    "geometry",
    "icosphere",
    "losses",
    "metrics",
    "models",
    "scenes",
)
ROOMS += ("sphere", "sweep", "viz")


def misuses() -> dict[str, tuple[str, str]]:
    """Call -> argument and word, of the table."""
    rows = (line.partition(" -> ") for line in MISUSES.strip().splitlines() if not line.startswith("#"))
    return {call: tuple(said.split(": ", 1)) for call, _, said in rows}  # type: ignore[misc]


def misuse(call: str) -> None:
    """Evaluate a call with all public names, and those of this file."""
    rooms = [getattr(sphericalvision, room) for room in ROOMS]
    eval(call, {name: getattr(room, name) for room in rooms for name in room.__all__} | globals())


@pytest.mark.parametrize("call", misuses())
def test_misuse_is_told_in_our_own_words(call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    argument, word = misuses()[call]
    monkeypatch.chdir(tmp_path)  # nothing is written, but if it were
    with pytest.raises(SphericalVisionError, match=f"(?s)({argument}).*({word})") as caught:
        misuse(call)
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
