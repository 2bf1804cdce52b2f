# SPDX-License-Identifier: Apache-2.0
"""Misuses of the library: each is told in the house's own words, never in those of torch. A new one is one line.

An error begins with the name of the argument, says what was expected and what came, and is of a type of the house.
"""

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sphericalvision import core
from sphericalvision.cameras import Camera, CameraRig, FisheyeCamera, PinholeCamera, ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.core import ArgumentTypeError
from sphericalvision.crown import Crown, CrownConv2d, to_crown
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork, IcoSweepNet
from sphericalvision.sweep import SphereSweep
from tests.values import names_in

NAN = math.nan
EYE, EYES = torch.eye(3), torch.eye(4)[None]
F, C, SIZE = [20.0, 20.0], [19.5, 15.5], (32, 40)
POINTS, INTEGERS = np.zeros((5, 3)), torch.tensor([[0, 0, 1]])
IMAGE, BYTES = torch.zeros(3, 32, 40), torch.zeros(3, 32, 40, dtype=torch.uint8)
DIRECTIONS = torch.tensor([[0.0, 0.6, 0.8]])
VALUES = torch.zeros(1, 3, 162)
IMAGES, SEEN = torch.zeros(1, 4, 3, 642), torch.ones(4, 642, dtype=torch.bool)
VIEWS = torch.zeros(1, 4, 3, 24, 24)
LABELS = torch.zeros(1, 162, dtype=torch.long)
BOARD = torch.tensor([[x, y, 0.0] for y in (0.0, 1.0) for x in (0.0, 1.0, 2.0)])


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
def pair() -> Any:
    """Tables of two cameras."""
    return SphereSweep(1, 4, 0.5, 3).tables(ring_rig(2))


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
# cameras
pinhole([NAN, 20.0]) -> focal_length: Argument
pinhole([-20.0, 20.0]) -> focal_length: Argument
pinhole('long') -> focal_length: Argument
pinhole(None) -> focal_length: Argument
pinhole([1.0, 2.0, 3.0]) -> focal_length: Shape
pinhole(torch.ones(2).half()) -> dtype: Argument
pinhole(size=4) -> image_size: Argument
pinhole(size=(4.5, 4)) -> image_size: Argument
pinhole(size=(-4, 4)) -> image_size: Argument
pinhole(size=('big', 'small')) -> image_size: Argument
pinhole(size=(NAN, 4)) -> image_size: Argument
pinhole(size=(math.inf, 4)) -> image_size: Argument
pinhole(size=(40000, 40000)) -> image_size: Argument
pinhole(max_angle=110) -> max_angle: Argument
pinhole(max_angle='wide') -> max_angle: Argument
PinholeCamera.from_field_of_view((8, 8), (1.0,)) -> field_of_view: ArgumentType
PinholeCamera(torch.ones(3, 2), torch.ones(2, 2), SIZE) -> intrinsics: Shape
KannalaBrandtCamera(F, C, None, SIZE) -> distortion: Argument
DoubleSphereCamera(F, C, 0.0, 2.0, SIZE) -> alpha: Argument
UnifiedCamera(F, C, -1.0, None, SIZE) -> xi: Argument
UnifiedCamera(F, C, 1.0, [0.0] * 3, SIZE) -> distortion: Argument
AtanCamera(F, C, 0.0, SIZE) -> omega: Argument
AtanCamera(F, C, 3.2, SIZE) -> omega: Argument
OCamCamera([], None, C, [1.0, 0, 0], SIZE, 1.0) -> polynomial: Shape
OCamCamera([-9.0, 0.1], None, C, [1, 0, NAN], SIZE, 1.0) -> affine: Argument
OCamCamera([100.0, 0.0, 1e-3], None, C, [1, 0, 0], SIZE, 1.0) -> polynomial: Argument
OCamCamera([-9.0, 0.0, 0.01], None, C, [1, 1, 1], SIZE, 1.0) -> affine: Argument
OCamCamera([-9.0, 0.0, 0.01], None, C, [1, 0, 0], SIZE, 110) -> max_angle: Argument
FisheyeCamera('fish', 5.0, C, SIZE) -> projection: Argument
FisheyeCamera.from_field_of_view(SIZE, 220) -> field_of_view: Argument
FisheyeCamera.from_field_of_view(SIZE, '220') -> field_of_view: ArgumentType
FisheyeCamera.stack([]) -> cameras: Argument
FisheyeCamera.from_field_of_view(SIZE, 3.84, 'orthographic') -> field_of_view: Argument
FisheyeCamera.stack([camera()] * 3).project(torch.zeros(2, 7, 3)) -> points or pixels: Shape
FisheyeCamera('equidistant', [5.0, 6.0], torch.ones(2, 2), SIZE) -> focal_length: Argument
camera().project([[0.0, 0.0, 1.0]]) -> points: ArgumentType
camera().project(None) -> points: ArgumentType
camera().project(DIRECTIONS.to(torch.complex64)) -> points: Argument
camera().unproject(torch.tensor([[1, 2]])) -> pixels: Argument
camera().contains(np.zeros((2, 2))) -> pixels: ArgumentType
camera().sample(torch.zeros(32, 40, 3), DIRECTIONS) -> image: Shape
camera().with_intrinsics(focal_length=200.0) -> focal_length: ArgumentType
camera().resized('big') -> image_size: Argument
camera().cropped(0.5, 0, 4, 4) -> cropped: ArgumentType
camera().cropped(0, 0, 400, 4) -> cropped: Argument
camera().to(torch.float16) -> dtype: Argument
camera().select(0) -> index: Argument
camera().cropped(-1, 0, 10, 10) -> cropped: Argument
camera().cropped(0, 30, 10, 11) -> cropped: Argument
undistorted_camera(camera(), (1.0, 1.0)) -> field_of_view: ArgumentType
undistorted_camera('camera') -> camera: ArgumentType
undistorted_camera(camera(), 1.0, 40.0) -> field_of_view, focal_length, balance: Argument
undistorted_camera(camera(), balance=1.5) -> balance: Argument
undistorted_camera(camera(), 3.5) -> field_of_view: Argument
undistorted_camera(camera(), focal_length=-3.0) -> focal_length: Argument
convert(camera(), to='fishy') -> to: Argument
convert(camera(), to=int) -> to: Argument
convert(camera(), to=1) -> to: Argument
convert(camera(), EquirectangularCamera) -> to: Argument
convert(EquirectangularCamera((32, 64)), 'ocam') -> to: Argument
convert(camera(), 'brown_conrady', num_coefficients=6) -> num_coefficients: Argument
convert(camera(), 'double_sphere', num_coefficients=2) -> num_coefficients: Argument
convert(camera(), 'ocam', projection='equidistant') -> projection: Argument
convert(camera(), 'pinhole', max_angle=1.6) -> max_angle: Argument
convert(camera(), 'ocam', max_angle=80) -> max_angle: Argument
convert(FisheyeCamera.stack([camera()] * 2), 'ocam') -> camera: Argument
convert(camera().cropped(0, 0, 2, 2), 'pinhole') -> camera: Argument
project_pinhole(DIRECTIONS, [1.0, 1.0], torch.ones(2)) -> focal_length: ArgumentType
field_of_view(3) -> camera: ArgumentType
undistort(IMAGE[0], camera(), 1.0) -> image: Shape
rectified_pairs(rig(), 'panorama') -> kind: Argument
rectified_pairs(rig(), pairs=[('cam1', 'left')]) -> cameras: Argument
rectified_pairs(at_once(), pairs=[('cam1', 'cam2')]) -> pairs: Argument
rectified_pairs(at_once()) -> rig: Argument
rectified_pairs(rig().subset([0])) -> rig: Argument
rectified_pairs(CameraRig([pinhole()] * 2, ring_rig(2).world_from_camera), pairs=[('cam1', 'cam2')]) -> pairs: Argument
rectified_pairs(CameraRig.stack([rig(), rig()])) -> rig: Argument
rectified_pairs(rig())[0].distance(torch.zeros(4, 4)) -> disparity: Shape
rectified_pairs(rig())[0].distance(torch.zeros(rectified_pairs(rig())[0].image_size), 'cam9') -> of: Argument
rectified_pairs(rig())[0].rectify({'cam1': IMAGE}) -> images: Argument
rectified_pairs(rig())[0].rectify(list(blank().values())) -> images: Argument
compare_cameras(camera(), camera().resized((16, 20))) -> second: Argument
compare_cameras(camera(), camera(), [0, 40, 80]) -> angles: Argument
read_camera(3) -> path: ArgumentType
save_camera(3, 'x.yaml') -> camera: ArgumentType
save_camera(camera(), 'x.yaml', 'yaml') -> format: Argument
save_camera(pinhole(), 'x.txt', 'opencv') -> path: Argument
CameraRig([], torch.zeros(0, 4, 4)) -> cameras: Argument
CameraRig(camera(), EYES) -> cameras: ArgumentType
CameraRig(['front'], EYES) -> cameras['cam1']: ArgumentType
CameraRig([camera()], EYE[None]) -> world_from_camera: Shape
CameraRig([camera()], np.eye(4)[None]) -> world_from_camera: ArgumentType
CameraRig([camera()], EYES.long()) -> world_from_camera: Argument
CameraRig([camera()], EYES * NAN) -> world_from_camera: Argument
CameraRig([camera()], torch.diag(torch.tensor([2.0, 2, 2, 1]))[None]) -> world_from_camera: Argument
CameraRig([camera()], torch.diag(torch.tensor([-1.0, 1, 1, 1]))[None]) -> world_from_camera: Argument
CameraRig([camera()], EYES + torch.eye(4).roll(3, 1).triu(3).mT) -> world_from_camera: Argument
CameraRig([camera()], EYES, {'cam1': np.ones(SIZE)}) -> masks['cam1']: ArgumentType
CameraRig([camera()], EYES, {'cam1': torch.ones(SIZE)}) -> masks['cam1']: Argument
CameraRig([camera()], EYES, {'x': torch.ones(SIZE)}) -> masks: Argument
rig().subset(['front']) -> cameras: Argument
rig().permuted([0, 1, 2, 2]) -> order: Argument
rig().resized({'front': (20, 24)}) -> image_size: Argument
CameraRig([camera()], EYES, around=['cam5']) -> around: Argument
CameraRig.stack([rig(), CameraRig(rig().cameras, rig().world_from_camera, around=['cam1'])]) -> rigs: Argument
CameraRig.stack([rig(), CameraRig({**rig().cameras, 'cam1': pinhole()}, rig().world_from_camera)]) -> rigs: Argument
Trajectory(['a', 'b'], EYES.repeat(2, 1, 1)).windows(3) -> size: Argument
Trajectory(['a', 'b'], EYES.repeat(2, 1, 1)).windows(2, spacing=0.3) -> spacing: Argument
Trajectory(['a', 'b'], EYES.repeat(2, 1, 1)).rig(camera(), [0, 2]) -> numbers: Argument
Trajectory(['0.0', '0.1', '0.2'], EYES.repeat(3, 1, 1)).of_images(['000', '001']) -> images: Argument
read_trajectory('none.txt') -> none.txt: MissingFile
read_trajectory('.') -> .: MissingFile
rig().rotated(rotation=2 * EYE) -> rotation: Argument
rig().rotated(EYE) -> tilt: Argument
rig().project(DIRECTIONS[0]) -> points: Shape
rig().points_seen(torch.ones(2, 2, 3), torch.zeros(1)) -> directions: Shape
rig().points_seen(DIRECTIONS, torch.zeros(2, 5)) -> inverse_depths: Shape
rig().points_seen(DIRECTIONS, torch.tensor([1.0, -1.0])) -> inverse_depths: Argument
CameraRig([camera()] * 4, EYES.repeat(3, 1, 1)) -> world_from_camera: Shape
rig().rotated(tilt=30) -> tilt: Argument
ring_rig(2.5) -> num_cameras: Argument
ring_rig(1) -> num_cameras: Argument
ring_rig(4, radius=0.0) -> radius: Argument
ring_rig(4, radius=NAN) -> radius: Argument
read_rig(3) -> path: ArgumentType
save_rig(camera(), 'x.yaml') -> rig: ArgumentType
save_rig(rig(), 'x.txt', 'ocamcalib') -> format: Argument
coverage(camera(), DIRECTIONS, [1.0]) -> rig: ArgumentType
coverage(ring_rig(3), torch.ones(2, 2, 3), [1.0]) -> directions: Shape
coverage(ring_rig(3), torch.eye(3), [1.0, 0.0]) -> depths: Argument
remap(IMAGE, camera(), camera(), 2 * EYE) -> rotation: Argument
remap(IMAGE, camera(), camera(), np.eye(3)) -> rotation: ArgumentType
remap(IMAGE, camera(), SIZE) -> target: ArgumentType
remap(IMAGE, camera(), camera(), fill='black') -> fill: ArgumentType
remap(IMAGE, camera(), camera(), mode='cubic') -> mode: Argument
remap(IMAGE, camera(), camera(), mask=torch.ones(60, 80)) -> mask: Shape
remap(IMAGE, camera(), camera(), torch.eye(4)) -> rotation: Shape
remap(BYTES, camera(), camera(), mode='nearest', fill=-1) -> fill: Argument
remap(IMAGE, camera(), camera(), mode='bicubic', mask=torch.ones(SIZE)) -> mask: Argument
EquirectangularCamera((4, 8), 1.0, latitudes=(0, 0.5)) -> vertical_field_of_view, latitudes: Argument
EquirectangularCamera((4, 8), latitudes=(0.5, -0.5)) -> latitudes: Argument
EquirectangularCamera((4, 8), longitudes=(0, 7)) -> longitudes: Argument
EquirectangularCamera((4, 8), longitudes=3) -> latitudes, longitudes: Argument
seen_by(ring_rig(4), torch.tensor([[0.0, -1.0, 0.0]]), -torch.ones(1)) -> inverse_depth: Argument
to_kornia(PinholeCamera([500.0, 510.0], [319.5, 239.5], (480, 640), skew=2.5)) -> camera: Argument
to_kornia(DoubleSphereCamera(F, C, -0.2, 0.6, SIZE)) -> camera: Argument
to_kornia(KannalaBrandtCamera(F, C, [0.01] * 6, SIZE)) -> camera: Argument
overlap(torch.ones(2, 4).int(), torch.ones(3)) -> solid_angles: Shape
ExtendedUnifiedCamera(F, C, 1.5, 1.0, SIZE) -> alpha: Argument
ExtendedUnifiedCamera(F, C, 0.5, 0.0, SIZE) -> beta: Argument
ThinPrismFisheyeCamera(F, C, [0.0] * 6, [0.0] * 2, [0.0] * 4, SIZE, composition='both') -> composition: Argument
ThinPrismFisheyeCamera(F, C, [0.0] * 6, [0.0] * 2, [0.0] * 2, SIZE) -> thin_prism: Shape
RadialPolynomialCamera([-1.0, 2.0], C, 1.0, SIZE) -> polynomial: Argument
RadialPolynomialCamera([9.0], C, 0.0, SIZE) -> aspect_ratio: Argument
BrownConradyCamera(F, C, [0.0] * 6, SIZE) -> distortion: Argument
Remap(camera(), camera())(IMAGE[0]) -> image: Shape
sample_sphere(rig(), [torch.zeros(3, 24, 24)] * 3, DIRECTIONS) -> images: Argument
sample_sphere(rig(), {'a': IMAGE, 'b': IMAGE}, DIRECTIONS) -> images: Argument
fit_inverse_polynomial(OCamCamera([-9.0, 0.0, 0.01], None, C, [1, 0, 0], SIZE), 18) -> degree: Argument
CameraModule(camera(), fixed=['focus']) -> fixed: Argument
# geometry
bilinear_sample(torch.zeros(2, 3, 4, 4), torch.zeros(3, 5, 2)) -> image and pixels: Shape
bilinear_sample(IMAGE, torch.zeros(2, 2), padding='wrap') -> padding: Argument
transform_from_quaternion(torch.zeros(4), torch.zeros(3)) -> quaternion: Argument
# icosphere
ico().nearest(torch.tensor([NAN, 0.0, 1.0])) -> directions: Argument
Icosphere(-1) -> level: Argument
Icosphere(30) -> level: Argument
Icosphere('5') -> level: Argument
Icosphere(2, torch.int64) -> dtype: Argument
Icosphere(1).locate(torch.zeros(4, 3, dtype=torch.long)) -> directions: Argument
Icosphere(1).sample(torch.zeros(1, 42), torch.ones(3)) -> directions: Shape
Icosphere(0).coarser() -> Icosphere.coarser: Argument
Icosphere(1.5) -> level: Argument
Icosphere(True) -> level: Argument
icosphere_pool(torch.ones(42), 'median') -> mode: Argument
icosphere_pool(torch.ones(12)) -> level: Argument
level_from_num_vertices('many') -> number of vertices: ArgumentType
level_from_num_vertices(43) -> number of vertices: Shape
icosphere_within(torch.ones(3), -0.1, 2) -> angle: Argument
icosphere_rings(1, 1, torch.tensor([42])) -> centers: Argument
icosphere_rings(1, -1) -> num_rings: Argument
icosphere_normals(torch.ones(43, 3)) -> number of vertices: Shape
IcospherePool(2)(torch.ones(1, 42)) -> values: Shape
icosphere_edges(-1) -> level: Argument
TriangleLocator(11) -> level: Argument
# sphere
resample(IMAGE, camera(), ico(), 2 * EYE) -> rotation: Argument
resample(IMAGE, camera(), ico(), torch.eye(4)) -> rotation: Shape
resample(IMAGE, camera(), 5) -> target: Argument
resample(IMAGE, rig(), ico()) -> source: Argument
resample(IMAGE, camera(), ico(), mask=np.ones(SIZE)) -> mask: ArgumentType
resample(VALUES, ico(), Equirectangular(4, 8), mode='cubic') -> mode: Argument
resample(torch.zeros(1, 6, 4, 4), Cubemap(4), ico(), mask=torch.ones(4, 4)) -> mask: Shape
resample(IMAGE, camera(), ico(), mask=torch.ones(4, 4)) -> mask: Shape
Equirectangular(4.5, 8) -> height: Argument
Equirectangular.with_square_pixels(5, 8) -> height, width: Argument
Equirectangular(4, 8, max_latitude=45.0) -> max_latitude: Argument
Equirectangular.with_square_pixels(2, 8).rows_of(torch.zeros(3, 8)) -> panorama: Shape
Equirectangular(4, 8, latitudes=(0.5, -0.5)) -> latitudes: Argument
Equirectangular(4, 8, latitudes=(0, 2)) -> latitudes: Argument
Equirectangular(4, 8, longitudes=(0, 7)) -> longitudes: Argument
Equirectangular(4, 8, longitudes=3) -> latitudes, longitudes: Argument
Equirectangular(10**7, 2 * 10**7) -> height, width: Argument
Equirectangular.with_square_pixels(10**6, 10**7) -> height, width: Argument
cube_pad(torch.zeros(1, 3, 5, 4, 4), 1) -> faces: Shape
cube_pad(torch.zeros(1, 3, 6, 4, 4), 9) -> padding: Argument
equirectangular_pad(torch.zeros(2, 4), 3) -> padding: Argument
equirectangular_pad(torch.zeros(4), 1) -> images: Shape
make_seamless(3) -> module: ArgumentType
make_seamless(torch.nn.Sequential(torch.nn.ReLU(), torch.nn.ConvTranspose2d(1, 1, 3))) -> module: Argument
make_seamless(torch.nn.Upsample(scale_factor=2, mode='bilinear')) -> module: Argument
SphereConv2d(3, 4)(torch.zeros(1, 3, 8, 16, dtype=DOUBLE)) -> images: Argument
SphereConv2d(-3, 4) -> in_channels: Argument
SphereConv2d(3, 8, 4) -> kernel_size: Argument
SphereConv2d(3, 8, 5)(torch.zeros(1, 3, 4, 8)) -> kernel_size: Argument
SphereConv2d(3, 8)(torch.zeros(1, 4, 8, 16)) -> images and weight: Shape
cube_to_layout(torch.zeros(5, 4, 4)) -> values: Shape
cube_to_layout(torch.zeros(6, 4, 4), 'cross') -> layout: Argument
cube_from_layout(torch.zeros(3, 10, 12), 'dice') -> faces: Shape
cube_from_layout({'front': torch.zeros(4, 4)}, 'dict') -> faces: Argument
Cubemap(0) -> size: Argument
Cubemap(128, 128) -> dtype: ArgumentType
Cubemap(4).sample(torch.zeros(6, 4, 4), DIRECTIONS) -> values: Shape
Cubemap(10**6) -> size: Argument
Healpix(3, nested=True) -> nside: Argument
Healpix(0) -> nside: Argument
Healpix(2).locate(torch.ones(1, 3), 'rings') -> interpolation: Argument
Healpix(2**20) -> nside: Argument
healpix_pool(torch.ones(108)) -> values: Argument
healpix_pool(torch.ones(12)) -> values: Argument
EquirectangularPad2d(-1) -> padding: Argument
CubePad2d(5)(torch.zeros(6, 3, 4, 4)) -> padding: Argument
Resample(Cubemap(4), Healpix(1), mode='bicubic') -> mode: Argument
Resample(Cubemap(4), 'cube') -> target: Argument
sphere_taps((8, 16), stride=(0, 1)) -> stride: Argument
TangentImages(0, 5, margin=2) -> size: Argument
TangentImages(3, 10**6) -> base_level, size: Argument
TangentImages(40, 8) -> level: Argument
ring_from_nested(torch.ones(2), 4) -> ids: Argument
nested_from_ring(torch.ones(2).bool(), 4) -> ids: Argument
views(torch.zeros(3, 24, 48)).merge(quantity='range') -> quantity: Argument
views(torch.zeros(1, 24, 48)).merge(quantity='depth') -> quantity: Argument
views(torch.zeros(1, 24, 48), layout='dodecahedron') -> layout: Argument
views(torch.zeros(1, 24, 48), layout=[(90, 0, 0)]) -> layout: Argument
views(torch.zeros(1, 24, 48), layout=[(0.0, 0.0)]) -> layout: Shape
views(torch.zeros(1, 24, 48), field_of_view=3.2) -> field_of_view: Argument
Views([torch.zeros(3, 24, 24)] * 2, rig()) -> images: Argument
Views.of_pairs(rectified_pairs(rig()), [torch.zeros(24, 24)]) -> disparities: Argument
Views([torch.zeros(1, 24, 24)] * 4, rig()).merge(center=rig().center) -> center: Argument
# crown
CrownConv2d(3, 4)(VALUES) -> crown: ArgumentType
CrownConv2d(3, 4)(crown(DOUBLE)) -> crown: Argument
CrownConv2d(5, 4)(crown()) -> crown: Shape
CrownConv2d(3, 4)(crown(torch.float32, 4)) -> crown: Shape
CrownConv2d(-3, 4) -> in_channels: Argument
CrownConv2d(3, 4, stride=3) -> stride: Argument
CrownConv2d(3, 5, stride=2)(to_crown(torch.zeros(1, 3, 12))) -> stride: Argument
CrownConv3d(3, 4)(VALUES) -> crown: ArgumentType
CrownConv3d(3, 4)(crown(DOUBLE, 4)) -> crown: Argument
CrownConv3d(3, 4, kernel_size=5) -> kernel_size: Argument
CrownConv3d(3, 5)(to_crown(torch.zeros(1, 3, 42))) -> crown: Shape
crown_relu(VALUES) -> crown: ArgumentType
exchange(VALUES) -> crown: ArgumentType
from_crown(VALUES) -> crown: ArgumentType
from_crown(Crown(crown().row, crown().col)) -> crown: Shape
from_crown(Crown(crown().col, crown().row.expand(2, -1, -1, -1, -1))) -> crown: Shape
crown_max_pool2d(VALUES) -> crown: ArgumentType
CrownBatchNorm2d(3)(VALUES) -> crown: ArgumentType
CrownBatchNorm2d(3)(crown(DOUBLE)) -> crown: Argument
CrownBatchNorm2d(4)(to_crown(torch.zeros(1, 3, 42))) -> crown: Shape
CrownPointwise(torch.nn.ReLU())(VALUES) -> crown: ArgumentType
CrownPointwise(torch.nn.Conv2d(3, 4, 1))(crown(DOUBLE)) -> crown: Argument
to_crown(VALUES[0]) -> values: Shape
CrownConvNorm2d(3, 4)(crown(DOUBLE)) -> crown: Argument
HexConv2d(3, 4)(VALUES.double()) -> values: Argument
HexConv2d(3, 4, kernel_size=5) -> kernel_size: Argument
HexConv2d(3, 4)(crown()) -> values: ArgumentType
HexConv2d(4, 5)(torch.zeros(1, 3, 42)) -> values: Shape
HexConv2d(3, 5, orientation='north', level=2)(torch.zeros(1, 3, 42)) -> values: Shape
HexConv2d(3, 5, orientation='north') -> level: Argument
HexConv2d(3, 5, orientation='south') -> orientation: Argument
HexConv2d(3, 5, stride=3) -> stride: Argument
HexConv2d(3, 5, stride=2)(torch.zeros(1, 3, 12)) -> stride: Argument
HexConv3d(3, 4)(torch.zeros(1, 3, 4, 162).double()) -> values: Argument
HexConv3d(3, 5)(torch.zeros(1, 3, 42)) -> values: Shape
crown_conv2d(crown(), torch.zeros(4, 3, 7), torch.zeros(3)) -> bias: Shape
crown() + VALUES -> crown: ArgumentType
crown() + to_crown(torch.zeros(1, 3, 42)) -> crown: Shape
CrownAvgPool2d()(to_crown(torch.zeros(1, 3, 12))) -> stride: Argument
CrownMaxPool2d()(to_crown(torch.zeros(1, 3, 12))) -> stride: Argument
CrownMaxPool2d()(to_crown(torch.zeros(1, 3, 4, 42))) -> crown: Shape
hex_group_conv2d(torch.zeros(1, 3, 162), torch.zeros(4, 3, 6, 7)) -> values: Shape
hex_group_conv2d(torch.zeros(1, 3, 6, 162), torch.zeros(4, 3, 7)) -> weight: Shape
# sweep
sweep()(torch.zeros(1, 3, 5, 162), rig()) -> features: Shape
sweep()(torch.zeros(1, 1, 5, 162), camera()) -> rig: ArgumentType
sweep()(torch.zeros(1, 4, 5, 162), rig(), torch.ones(4, 162)) -> seen: Argument
SphereSweep(2, 1, 0.5) -> num_hypotheses: Argument
SphereSweep(2, 8.5, 0.5) -> num_hypotheses: Argument
SphereSweep(2, 10 ** 9, 0.5) -> num_hypotheses: Argument
SphereSweep(2, 8, 0.0) -> min_depth: Argument
SphereSweep(2, 8, NAN) -> min_depth: Argument
SphereSweep(2, 8, 'near') -> min_depth: ArgumentType
sweep()(torch.zeros(1, 4, 5, 162), rig(), SEEN[:2, :162]) -> seen: Shape
SphereSweep(-1, 4, 0.5) -> level: Argument
sweep()(torch.zeros(3, 4, 2, 162), CameraRig.stack([rig(), rig()])) -> rig: Shape
sweep()(torch.zeros(1, 4, 5, 162), SphereSweep(3, 8, 0.5).tables(rig())) -> rig: Shape
sweep()(torch.zeros(1, 4, 5, 162), SphereSweep(2, 9, 0.5).tables(rig())) -> rig: Shape
PanoramaSweep((8, 16), 8, 0.5).tables(camera()) -> rig: ArgumentType
PanoramaSweep((4, 8), 4, 0.5)(torch.zeros(1, 3, 3, 12, 12), rig()) -> features: Shape
PanoramaSweep((4, 8), 4, 0.5)(torch.zeros(3, 4, 3, 12, 12), CameraRig.stack([rig(), rig()])) -> rig: Shape
PanoramaSweep((4, 8), 4, 0.5).tables(rig().resized({'cam1': (10, 10)})) -> rig: Argument
PanoramaSweep((4, 8), 4, 0.5).tables_for(VIEWS, PanoramaSweep((8, 16), 4, 0.5).tables(rig())) -> rig: Shape
soft_argmax(torch.zeros(8)) -> logits: Shape
photo_consistency(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, level=4) -> level: Argument
photo_consistency(torch.zeros(2, 3, 642), ring_rig(2), 8, 0.5) -> sphere_images: Shape
photo_consistency(IMAGES, rig(), 8, 0.5, seen=SEEN.float()) -> seen: Argument
correlation_evidence(IMAGES[0], pair()) -> images: Shape
correlation_evidence(IMAGES[:, :1], pair()) -> images: Shape
correlation_evidence(IMAGES[:, :2], pair(), SEEN[0]) -> seen: Shape
correlation_evidence(IMAGES[:, :2], pair(), level=2) -> level: Argument
correlation_evidence(IMAGES[:, :2], SweepTables(*(x.expand(3, *x.shape) for x in pair()))) -> tables: Shape
Concatenation(3, 4)(SweepVolume(torch.zeros(1, 2, 3, 5, 6), torch.ones(1, 2, 5, 6) > 0)) -> volume: Shape
photo_consistency_share(torch.zeros(1, 2562), IMAGES, rig(), 9, 0.5) -> index: Shape
photo_consistency_share(torch.zeros(2, 642), torch.zeros(1, 4, 3, 10242), rig(), 9, 0.5) -> sphere_images: Shape
photo_consistency_share(torch.zeros(1, 42), IMAGES, semi_global_tables(rig(), 9, 0.5, 2), 9, 0.5, SEEN) -> rig: Shape
semi_global_sweep(IMAGES[:, :2], semi_global_tables(ring_rig(2), 9, 0.5, 3, substeps=1), 8, 0.5) -> rig: Argument
semi_global_sweep(IMAGES[:, :1], rig(), 8, 0.5) -> sphere_images: Shape
photo_consistency(IMAGES, rig(), 8, 0.0) -> min_depth: Argument
semi_global_sweep(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, cost_level=4) -> level, cost_level: Argument
semi_global_sweep(torch.zeros(1, 2, 3, 642)[0], ring_rig(2), 8, 0.5) -> sphere_images: Shape
semi_global_sweep(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, substeps=0) -> substeps: Argument
semi_global_sweep(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, level=11) -> level: Argument
semi_global_sweep(IMAGES[:, :2], ring_rig(2), 8, 0.5, small_penalty=5.0) -> small_penalty, large_penalty: Argument
semi_global_sweep(torch.zeros(1, 2, 3, 642), ring_rig(2), 8, 0.5, seen=torch.ones(3, 642) > 0) -> seen: Shape
semi_global_sweep(IMAGES, semi_global_tables(rig(), 8, 0.5, 2), 8, 0.5, seen=SEEN) -> rig: Shape
semi_global_sweep(IMAGES, rig(), 8, 0.5, seen=SEEN.byte()) -> seen: Argument
semi_global_smoothing(torch.zeros(1, 4, 42), 0.5, 0.1) -> small_penalty, large_penalty: Argument
semi_global_smoothing(torch.zeros(1, 4, 42)[0], 0.1, 0.5) -> cost: Shape
semi_global_smoothing(torch.zeros(1, 4, 42), 0.1, 0.5, torch.zeros(1, 3, 162)) -> guide: Shape
semi_global_smoothing(torch.zeros(1, 4, 42), 0.1, 0.5, contrast=0.0) -> contrast: Argument
inverse_depth_hypotheses(2.5, 0.5) -> num_hypotheses: Argument
inverse_depth_hypotheses(8, 5e-324) -> min_depth: Argument
inverse_depth_hypotheses(8, 1e10) -> min_depth: Argument
# models
net()(torch.zeros(1, 4, 3, 2562).double(), rig()) -> images: Argument
net()(torch.zeros(1, 3, 3, 2562), rig().subset([0, 1, 2])) -> images: Shape
net()(torch.zeros(1, 4, 3, 2562), None) -> rig: ArgumentType
net()(torch.zeros(1, 4, 3, 2562), ring_rig(3)) -> features: Shape
pretrained('resnet') -> name: Argument
SphereSegmenter('planar', 2) -> level: Argument
SemiGlobalSweep(4, 8, depth_coarsening=5) -> depth_coarsening: Argument
SemiGlobalSweep(3, 8).predict(IMAGES, rig(), hint=DepthHint(torch.ones(1, 42), torch.ones(1, 42))) -> hint: Argument
depth_error(torch.ones(1, 42), torch.ones(1, 42), max_depth=0.0) -> max_depth: Argument
save_weights(net(), 'net.pth') -> path: Argument
save_weights(net(), 'net.safetensors', bits=12) -> bits: Argument
ConstantDepth(3, 8, 0.5).fit(torch.ones(1, 1), torch.zeros(1, 1) > 0) -> inverse_depth: Argument
IcoSweepNet(3, feature_coarsening=3) -> coarsening: Argument
IcoSweepNet(3, volume_channels=0) -> volume_channels: Argument
IcoSweepNet(3, aggregation='median') -> aggregation: Argument
IcoSweepNet(30) -> level: Argument
IcoSweepNet(1) -> level: Argument
IcoSweepNet(3, 1) -> num_hypotheses: Argument
IcoSweepNet(3, min_depth=-1.0) -> min_depth: Argument
IcoSweepNet(3, num_cameras=0) -> num_cameras: Argument
RefinedSweepNet(level=4) -> level: Argument
RefinedSweepNet.around(torch.nn.Identity()) -> prior: Argument
OmniMVS(output_size=(160, 600)) -> output_size: Argument
OmniMVS(output_size=(33, 64)) -> output_size: Argument
OmniMVS(output_size=(64, 64)) -> height, width: Argument
OmniMVS(15) -> num_hypotheses: Argument
OmniMVS(8, in_channels=2) -> in_channels: Argument
OmniMVS(8, aggregation='sum') -> aggregation: Argument
OmniMVS(8, norm='layer') -> norm: Argument
OmniMVS(8, num_scales=0) -> num_scales: Argument
RomniStereo(16, output_size=(15, 64)) -> output_size: Argument
RomniStereo(14) -> num_hypotheses: Argument
RomniStereo(17) -> num_hypotheses: Argument
RomniStereo(16, iterations=0) -> iterations: Argument
RomniStereo(16, in_channels=2) -> in_channels: Argument
# metrics
DepthIndexError(8).update(np.zeros((1, 3)), torch.zeros(1, 3)) -> pred_index: ArgumentType
DepthIndexError(0) -> num_hypotheses: Argument
DepthIndexError(8).update(torch.zeros(1, 5), torch.zeros(1, 6)) -> target_index: Shape
DepthIndexError(8).update(torch.zeros(1, 5), torch.zeros(1, 5), torch.ones(5, dtype=torch.bool)) -> mask: Shape
DepthIndexError(8).update(torch.zeros(1, 5), torch.zeros(1, 5), weights=torch.ones(4)) -> weights: Shape
DepthError().update(torch.ones(1, 3), np.ones((1, 3))) -> target_depth: ArgumentType
DepthError(max_depth=0.0) -> max_depth: Argument
SolidAngleMean(3) -> grid: ArgumentType
SolidAngleMean(Equirectangular(4, 8)).update(torch.zeros(1, 8, 4)) -> values: Shape
SolidAngleMean(Equirectangular(4, 8)).update(torch.zeros(2, 4, 8), torch.ones(1, 4, 8)) -> mask: Shape
SolidAngleIoU(ico(), 2).update(LABELS + 0.5, LABELS) -> pred: Argument
SolidAngleIoU(ico(), 2).update(LABELS, LABELS.float()) -> target: Argument
SolidAngleIoU(ico(), 3, ignore_index=-1).update(LABELS.byte(), LABELS.byte() + 255) -> target: Argument
SolidAngleIoU(ico(), 2).update(LABELS, LABELS + 7) -> target: Argument
seam_mask(torch.tensor([[0.0, -1.0, 0.0]]), 0.0) -> angle: Argument
omnimvs_error(torch.zeros(1, 8, 24), torch.zeros(1, 8, 24)) -> pred_inverse_depth: Shape
omnimvs_error(torch.zeros(1, 8, 16), torch.zeros(1, 8)) -> target_inverse_depth: Shape
evaluation_mask(ring_rig(4), torch.tensor([[0.0, -1.0, 0.0]]), torch.zeros(1)) -> inverse_depth: Shape
evaluation_mask(rig(), DIRECTIONS, torch.zeros(1, 1), torch.ones(2, 1)) -> valid: Shape
OmniMVSError(min_depth=0.0) -> min_depth: Argument
OmniMVSError().update(torch.zeros(1, 8, 16), torch.zeros(1, 8, 16), weights=torch.ones(128)) -> weights: Argument
ByRegion(DepthIndexError(8), {}) -> regions: Argument
ByRegion(DepthIndexError(8), {'seam': torch.ones(3)}).update(torch.zeros(1, 4), torch.zeros(1, 4)) -> prediction: Shape
left_right_error(torch.ones(2, 3), torch.ones(2, 3)) -> pred: Shape
# losses
depth_index_huber(torch.zeros(1, 5), torch.zeros(1, 5), delta=-1.0) -> delta: Argument
depth_index_huber(torch.zeros(1, 5), torch.zeros(1, 5), weights=torch.ones(4)) -> weights: Shape
depth_index_huber(torch.zeros(2, 5), torch.zeros(2, 1, 5)) -> target_index: Shape
depth_index_huber(torch.zeros(2, 5), torch.zeros(2, 5), torch.ones(5, dtype=torch.bool)) -> mask: Shape
# data
collate_samples([3]) -> samples: ArgumentType
collate_samples([{'a': 1}, {'b': 2}]) -> samples: Argument
collate_samples([]) -> samples: Argument
collate_samples([{'images': {'a': IMAGE}}, {'images': {'a': IMAGE[:, 1:]}}]) -> images.a: Shape
random_rotations(-1) -> count: Argument
Compose([max, min]) -> transforms: ArgumentType
RandomYaw(Icosphere(1), p=2.0) -> p: Argument
RandomYaw(Icosphere(1))({'normals': torch.rand(1, 2, 42)}) -> normals: Shape
RandomYaw(Icosphere(1), angles='exact') -> angles: Argument
RandomYaw(Icosphere(1))({'colour': torch.rand(1, 42)}) -> sample: Argument
RandomYaw(Icosphere(1)).inverse(torch.rand(1, 3, 42)) -> params: Argument
RandomYaw(Icosphere(1), kinds={'flow': 'vectors'}) -> kinds['flow']: Argument
RandomYaw(Icosphere(1))({'image': torch.rand(2, 3, 42), 'depth': torch.rand(42)}) -> depth: Shape
RandomYaw(ico())({'images': VALUES, 'panorama_valid': torch.ones(4, 8), 'rig': rig()}) -> sample: Argument
RandomSphereRotation(Icosphere(1), max_angle=0.0) -> max_angle: Argument
RandomSphereRotation(ico())({'images': VALUES, 'panorama_valid': SEEN, 'rig': rig()}) -> sample: Argument
RotateFisheye(mode='depth') -> mode: Argument
RotateFisheye(rotation=torch.eye(4)) -> rotation: Shape
RotateFisheye()({'images': VALUES, 'rig': rig()}) -> RotateFisheye: Argument
RotateFisheye()({'images': {'cam1': IMAGE}, 'rig': rig()}) -> images: Argument
SampleView(-1) -> level: Argument
SampleView() -> view: Argument
SampleView(panorama=(10, 30)) -> panorama: Shape
RandomShift()({'images': VALUES, 'rig': rig()}) -> RandomShift: Argument
RotateFivefold(steps=1)({'panorama_valid': torch.ones(8, 16), 'rig': rig()}) -> panorama_valid: Argument
truth_from_points(torch.ones(4), ico()) -> points: Shape
truth_from_points(torch.full((3, 3), NAN), ico()) -> points: Argument
truth_from_points(torch.ones(3, 3), ico(), gap=-1.0) -> gap: Argument
# scenes
make_scene('room', seed='a') -> seed: ArgumentType
make_scene('moon') -> kind: Argument
make_scene(scale=0.0) -> scale: Argument
MeshScene(None, up='x') -> up: Argument
MeshScene(None, scale=0.0) -> scale: Argument
make_scene(clear_radius=2.0) -> clear_radius: Argument
render_rig(None, rig()) -> scene: ArgumentType
render_rig(make_scene('bare'), camera()) -> rig: ArgumentType
render_directions(make_scene('bare'), torch.zeros(3), POINTS) -> directions: ArgumentType
World(rig(), kind='street') -> kind: Argument
World(rig(), min_depth=0.0) -> min_depth: Argument
World(rig(), tilts=(0.4, 0.1)) -> tilts: Argument
World(rig(), tilts=(-0.3, 0.8), carrier='pole') -> tilts: Argument
World(rig(), kind={'forest': 1.0}) -> shares: Argument
WorldSamples(World(rig()), SampleView(1), range(0)) -> seeds: Argument
WorldSamples(World(rig()), SampleView(1), range(-1, 1)) -> seeds: Argument
WorldSamples(World(rig()), SampleView(1), range(10_000_000, 10_000_001)) -> seeds: Argument
WorldSamples(World(ring_rig(4, 1.2)), SampleView(1), range(1)) -> rig: Argument
WorldSamples(World(rig().resized({'cam1': (20, 20)})), SampleView(images=True), range(1))[0] -> images: Shape
render_camera(make_scene(), camera(), torch.eye(4), samples_per_pixel=0) -> samples_per_pixel: Argument
# viz
rig_picture(camera()) -> rig: ArgumentType
rig_picture(CameraRig.stack([rig(), rig()])) -> rig: Argument
save_point_cloud('x.ply', POINTS, torch.zeros(5, 3)) -> points: ArgumentType
save_point_cloud('x.doc', DIRECTIONS, DIRECTIONS) -> path: Argument
save_point_cloud('x.ply', torch.zeros(4, 3), torch.zeros(5, 3)) -> colors: Shape
save_point_cloud('x.ply', torch.tensor([[NAN, 0.0, 0.0]]), torch.zeros(1, 3)) -> points: Argument
icosphere_mesh(5) -> depth: ArgumentType
icosphere_mesh(torch.ones(42), torch.ones(42, 3)) -> colors: Shape
sphere_mesh(ico()) -> values: ArgumentType
sphere_mesh(torch.ones(2, 42)) -> values: Shape
angle_map(PinholeCamera([200.0, 200.0], [99.5, 99.5], (200, 200)), torch.zeros(3, 100, 200)) -> image: Shape
error_to_color(torch.ones(2), 0.0) -> max_error: Argument
sheet([np.zeros((2, 2, 3))]) -> picture: Shape
sheet([]) -> sheet: Argument
depth_panorama(torch.ones(1, 4, 8), 0.5) -> depth: Shape
rgb_panorama(rig(), {}, 16) -> images: Argument
rgb_panorama(rig(), pictures(torch.zeros(3, 24, 24)), 16, torch.ones(8, 16)) -> depth: Shape
depth_to_color(torch.ones(2), 2.0, 1.0) -> min_depth, max_depth: Argument
depth_to_color(torch.ones(2), NAN, 1.0) -> min_depth, max_depth: Argument
depth_to_color(torch.ones(2), 0.0, math.inf) -> min_depth, max_depth: Argument
coverage_panorama(CameraRig.stack([rig(), rig()])) -> rig: Argument
# capture
Predictor(rig().subset(['cam1']), min_depth=0.5) -> rig: Argument
Predictor(CameraRig([camera()] * 2, EYES.repeat(2, 1, 1)), min_depth=0.5) -> rig: Argument
Predictor(camera()) -> rig: ArgumentType
Predictor(rig(), min_depth='near') -> min_depth: Argument
Predictor(rig(), min_depth=True) -> min_depth: Argument
Predictor(rig(), min_depth=NAN) -> min_depth: Argument
Predictor(rig(), method='semi_global', level=50) -> level: Argument
Predictor(rig(), device='gpu') -> device: Argument
Predictor(rig(), method='magic') -> method: Argument
sees(3) -> images: Argument
sees(pictures('a.png')) -> images['cam1']: Argument
sees(pictures(torch.empty(3, 24, 24, device='meta'))) -> images['cam1']: Argument
sees({'cam1': torch.zeros(3, 24, 24)}) -> images: Argument
sees(pictures(torch.zeros(3, 5, 24))) -> images['cam1']: Shape
sees(pictures(torch.full((3, 24, 24), 200.0))) -> images['cam1']: Argument
ToSphere(2).images(pictures(torch.full((3, 24, 24), 200.0)), rig()) -> images: Argument
sees(pictures(torch.full((3, 24, 24), NAN))) -> images['cam1']: Argument
sees(blank() | {'left': IMAGE}) -> images: Argument
sees(blank() | {'cam3': torch.zeros(1, 3, 24, 24)}) -> images: Shape
sees(pictures(torch.zeros(24, 24, dtype=torch.int64))) -> images['cam1']: Argument
Predictor(rig().subset([0, 1, 2]), net()) -> rig: Argument
Charuco(6, 4, 0.03, 0.04) -> marker: Argument
Charuco(20, 20, 0.04, 0.03) -> dictionary: Argument
Checkerboard(2, 5, 0.04) -> columns, rows: Argument
sees(blank()).points(voxel=0.0) -> voxel: Argument
sees(blank()).points(50) -> min_confidence: Argument
sees(blank()).mesh(max_depth=NAN) -> max_depth: Argument
sees(blank()).camera('cam9') -> camera: Argument
sees(blank()).camera('cam2', torch.eye(4)) -> world_from_camera: Argument
sees(blank()).camera(camera(), 1000 * torch.eye(4)) -> world_from_camera: Argument
sees(blank()).camera(camera(), torch.eye(4)[:3]) -> world_from_camera: Shape
predictor()(blank(), POINTS) -> hint: Argument
Preparation(photometric='yes') -> photometric: Argument
calibrate_photometry(rig(), {'cam1': IMAGE}) -> images: Argument
calibrate_photometry(rig(), pictures(torch.zeros(3, 24, 24)), depth=-1) -> depth: Argument
calibrate_photometry(rig(), pictures(torch.zeros(3, 8, 8))) -> images['cam1']: Shape
find_own_body(rig(), [{'cam1': torch.zeros(3, 24, 24)}]) -> frames: Argument
find_own_body(rig(), [pictures(torch.zeros(3, 8, 8))]) -> frames['cam1']: Shape
find_own_body(rig(), [], margin=-1) -> margin: Argument
align_rig_direct(rig().subset([0]), {'cam1': torch.zeros(3, 24, 24)}, DIRECTIONS, torch.ones(1)) -> rig: Argument
align_rig_direct(rig(), {'cam1': IMAGE}, DIRECTIONS, torch.ones(1)) -> images: Argument
align_rig_direct(rig(), blank(), DIRECTIONS, torch.ones(7)) -> inverse_depth: Shape
align_rig_direct(rig(), blank(), DIRECTIONS, torch.ones(1), torch.ones(7)) -> weights: Shape
align_rig_direct(rig(), blank(), DIRECTIONS, torch.ones(2, 1)) -> images['cam1']: Shape
align_rig_direct(rig(), blank(), DIRECTIONS, torch.ones(1), iterations=0) -> iterations: Argument
align_rig_direct(rig(), blank(), DIRECTIONS[None], torch.ones(1)) -> directions: Shape
align_rig_direct(at_once(), blank(), DIRECTIONS, torch.ones(1)) -> rig: Argument
Hint.of_points(torch.zeros(5, 3)) -> hint: Argument
Hint.of_points(torch.full((5, 3), NAN)) -> hint: Argument
Hint.of_points(torch.zeros(0, 3)) -> hint: Argument
Hint.of_directions(torch.zeros(5, 3), torch.ones(5)) -> hint: Argument
Hint.of_views(Views(pictures(torch.zeros(1, 24, 24)), rig())) -> hint: Argument
Hint.of_views(Views(pictures(torch.zeros(1, 24, 24)), rig()), fit='affine') -> hint: Argument
Hint.of_views(Views(pictures(-torch.ones(1, 24, 24)), rig())) -> hint: Argument
Hint.of_views(Views(blank(), rig())) -> views: Shape
Hint.of_views(torch.ones(4, 1, 5, 5)) -> views: ArgumentType
Hint.of_points(torch.ones(5, 3), 3.0) -> weight: Argument
Hint.of_points(torch.ones(5, 2)) -> points: Shape
Hint.of_points(INTEGERS) -> points: Argument
Hint.of_points(torch.ones(5, 3), fit='affine') -> fit: Argument
Hint.of_directions(torch.ones(5, 3), torch.ones(4)) -> inverse_depth: Shape
Hint.of_directions(torch.ones(8, 2, 3), torch.ones(8, 2), torch.ones(2, 8)) -> weight: Shape
Hint.of_directions(torch.ones(8, 2, 3), torch.ones(8, 2), np.ones((8, 2))) -> weight: ArgumentType
Hint.of_directions(POINTS, torch.ones(5)) -> directions: ArgumentType
Hint.of_directions(torch.ones(5, 3), POINTS) -> inverse_depth: ArgumentType
Hint.of_depth(torch.ones(5), torch.eye(4)) -> depth: ArgumentType
Hint.of_depth(sees(blank()), torch.eye(3)) -> pose: Shape
Hint.of_depth(sees(blank()), 2 * torch.eye(4)) -> pose: Argument
Hint.of_depth(sees(blank()), torch.eye(4).roll(1)) -> pose: Argument
refine(camera(), BOARD, torch.ones(2, 6, 2), fixed=('f',)) -> fixed: Argument
refine(camera(), BOARD[:5], torch.ones(2, 5, 2)) -> pixels: Argument
refine(camera(), BOARD, torch.ones(2, 5, 2)) -> pixels: Shape
refine(EquirectangularCamera((100, 200)), BOARD, torch.ones(2, 6, 2)) -> camera: Argument
refine_rig(rig(), BOARD, torch.ones(2, 4, 6, 2), intrinsics=('omega',)) -> intrinsics: Argument
refine_rig(rig(), BOARD, torch.ones(2, 3, 6, 2)) -> pixels: Shape
register_aggregation('variance', Concatenation) -> aggregation: Argument
register_network('module', torch.nn.Linear) -> network: Argument
register_network('omnimvs', IcoSweepNet) -> network: Argument
register_camera(type('Other', (PinholeCamera,), {})) -> model: Argument
convert(camera(), type('Silent', (PinholeCamera,), {'model': 'silent'})) -> to: Argument
load_reference_checkpoint('absent.pth') -> absent.pth: MissingFile
net().with_changes(nonesuch=1) -> nonesuch: Argument
"""
"""The call -> the argument that the message begins with: the type of the error, ``ArgumentError`` or another."""


def misuses() -> dict[str, tuple[str, str]]:
    """Call -> argument and type, of the table."""
    rows = (line.partition(" -> ") for line in MISUSES.strip().splitlines() if not line.startswith("#"))
    return {call: tuple(error.split(": ")) for call, _, error in rows}  # type: ignore[misc]


def misuse(call: str) -> None:
    """Evaluate a call with all public names, and those of this file."""
    eval(call, names_in(call) | globals())


@pytest.mark.parametrize("call", misuses())
def test_misuse_is_told_in_our_own_words(call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    argument, kind = misuses()[call]
    monkeypatch.chdir(tmp_path)  # nothing is written, but if it were
    with pytest.raises(getattr(core, f"{kind}Error")) as caught:
        misuse(call)
    assert str(caught.value).startswith(f"{argument}: ")
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
