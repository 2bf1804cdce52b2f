# SPDX-License-Identifier: Apache-2.0
"""Misuses of the library: each is told in the house's own words, never in those of torch. A new one is a row.

An error begins with the name of the argument, says what was expected and what came, and is of a type of the house.
"""

import ast
import functools
import inspect
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

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


def pinhole(focal_length: Any = F, image_size: Any = SIZE, max_angle: Any = 1.0) -> PinholeCamera:
    return PinholeCamera(focal_length, C, image_size, max_angle)


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
MODULES = """data.augmentation.fivefold data.omnistereo.ground_truth data.omnistereo.releases data.omnistereo.writer
icosphere.hierarchy io.images metrics.spread scenes.disturbances scenes.rendering.primitives scenes.rendering.raycast
sphere.intake"""
"""Where names of the table come from, besides those that are public."""

CHANGES = r"""
# cameras
pinhole() <- focal_length=[NAN, 20.0]; focal_length=[-20.0, 20.0]; focal_length='long'; focal_length=None;
    image_size=4; image_size=(4.5, 4); image_size=(-4, 4); image_size=('big', 'small'); image_size=(NAN, 4);
    image_size=(math.inf, 4); image_size=(40000, 40000); max_angle=110; max_angle='wide';
    Shape focal_length=[1.0, 2.0, 3.0]
UnifiedCamera(F, C, 1.0, None, SIZE) <- xi=-1.0; distortion=[0.0] * 3
AtanCamera(F, C, 1.0, SIZE) <- omega=0.0; omega=3.2
OCamCamera([-9.0, 0.1], None, C, [1, 0, 0], SIZE, 1.0) <- affine=[1, 0, NAN]; polynomial=[100.0, 0.0, 1e-3];
    affine=[1, 1, 1]; max_angle=110; Shape polynomial=[]
FisheyeCamera('equidistant', 5.0, torch.ones(2, 2), SIZE) <- projection='fish'; focal_length=[5.0, 6.0]
FisheyeCamera.from_field_of_view(SIZE, 3.0) <- field_of_view=220; ArgumentType field_of_view='220'
camera().project(DIRECTIONS) <- points=DIRECTIONS.to(torch.complex64); ArgumentType points=[[0.0, 0.0, 1.0]];
    ArgumentType points=None
undistorted_camera(camera()) <- balance=1.5; field_of_view=3.5; focal_length=-3.0;
    ArgumentType field_of_view=(1.0, 1.0); ArgumentType camera='camera'
convert(camera(), 'pinhole') <- to='fishy'; to=int; to=1; to=EquirectangularCamera; num_coefficients=6;
    num_coefficients=2; projection='equidistant'; max_angle=1.6; max_angle=80;
    camera=FisheyeCamera.stack([camera()] * 2); camera=camera().cropped(0, 0, 2, 2);
    to=type('Silent', (PinholeCamera,), {'model': 'silent'})
rectified_pairs(rig()) <- kind='panorama'; rig=at_once(); rig=rig().subset([0]); rig=CameraRig.stack([rig(), rig()])
rectified_pairs(rig())[0].distance(torch.zeros(rectified_pairs(rig())[0].image_size)) <- of='cam9';
    Shape disparity=torch.zeros(4, 4)
compare_cameras(camera(), camera()) <- second=camera().resized((16, 20)); angles=[0, 40, 80]
save_camera(pinhole(), 'x.yaml', 'opencv') <- format='yaml'; path='x.txt'; ArgumentType camera=3
CameraRig([camera()], EYES) <- cameras=[]; world_from_camera=EYES.long(); world_from_camera=EYES * NAN;
    world_from_camera=torch.diag(torch.tensor([2.0, 2, 2, 1]))[None];
    world_from_camera=torch.diag(torch.tensor([-1.0, 1, 1, 1]))[None];
    world_from_camera=EYES + torch.eye(4).roll(3, 1).triu(3).mT; masks={'cam1': torch.ones(SIZE)};
    masks={'x': torch.ones(SIZE)}; around=['cam5']; Shape world_from_camera=EYE[None];
    Shape world_from_camera=EYES.repeat(3, 1, 1); ArgumentType cameras=camera(); ArgumentType cameras=['front'];
    ArgumentType world_from_camera=np.eye(4)[None]; ArgumentType masks={'cam1': np.ones(SIZE)}
Trajectory(['a', 'b'], EYES.repeat(2, 1, 1)).windows(2) <- size=3; spacing=0.3
rig().rotated() <- rotation=2 * EYE; tilt=EYE; tilt=30
rig().points_seen(DIRECTIONS, torch.zeros(1)) <- inverse_depths=torch.tensor([1.0, -1.0]);
    Shape directions=torch.ones(2, 2, 3); Shape inverse_depths=torch.zeros(2, 5)
ring_rig() <- num_cameras=2.5; num_cameras=1; radius=0.0; radius=NAN
save_rig(rig(), 'x.txt') <- format='ocamcalib'; ArgumentType rig=camera()
coverage(ring_rig(3), DIRECTIONS, [1.0]) <- depths=[1.0, 0.0]; Shape directions=torch.ones(2, 2, 3);
    ArgumentType rig=camera()
remap(IMAGE, camera(), camera(), mode='bicubic') <- rotation=2 * EYE; mode='cubic'; mask=torch.ones(SIZE);
    Shape mask=torch.ones(60, 80); Shape rotation=torch.eye(4); ArgumentType rotation=np.eye(3);
    ArgumentType target=SIZE; ArgumentType fill='black'
EquirectangularCamera((4, 8), 1.0) <- latitudes=(0, 0.5); latitudes=(0.5, -0.5); longitudes=(0, 7); longitudes=3
ExtendedUnifiedCamera(F, C, 0.5, 1.0, SIZE) <- alpha=1.5; beta=0.0
ThinPrismFisheyeCamera(F, C, [0.0] * 6, [0.0] * 2, [0.0] * 4, SIZE) <- composition='both'; Shape thin_prism=[0.0] * 2
RadialPolynomialCamera([9.0], C, 1.0, SIZE) <- polynomial=[-1.0, 2.0]; aspect_ratio=0.0
sample_sphere(rig(), [torch.zeros(3, 24, 24)] * 4, DIRECTIONS) <- images=[torch.zeros(3, 24, 24)] * 3;
    images={'a': IMAGE, 'b': IMAGE}
# icosphere
Icosphere(2) <- level=-1; level=30; level='5'; dtype=torch.int64; level=1.5; level=True
icosphere_rings(1, 1) <- centers=torch.tensor([42]); num_rings=-1
# sphere
resample(IMAGE, camera(), ico()) <- rotation=2 * EYE; target=5; source=rig(); mode='cubic';
    Shape rotation=torch.eye(4); Shape mask=torch.ones(4, 4); ArgumentType mask=np.ones(SIZE)
Equirectangular(4, 8) <- height=4.5; max_latitude=45.0; latitudes=(0.5, -0.5); latitudes=(0, 2); longitudes=(0, 7);
    longitudes=3
cube_pad(torch.zeros(1, 3, 6, 4, 4), 1) <- padding=9; Shape faces=torch.zeros(1, 3, 5, 4, 4)
equirectangular_pad(torch.zeros(2, 4), 1) <- padding=3; Shape images=torch.zeros(4)
make_seamless(torch.nn.ReLU()) <- module=torch.nn.Sequential(torch.nn.ReLU(), torch.nn.ConvTranspose2d(1, 1, 3));
    module=torch.nn.Upsample(scale_factor=2, mode='bilinear'); ArgumentType module=3
SphereConv2d(3, 4) <- in_channels=-3; kernel_size=4
cube_to_layout(torch.zeros(6, 4, 4)) <- layout='cross'; Shape values=torch.zeros(5, 4, 4)
cube_from_layout(torch.zeros(3, 9, 12), 'dice') <- faces={'front': torch.zeros(4, 4)};
    Shape faces=torch.zeros(3, 10, 12)
Cubemap(128) <- size=0; size=10**6; ArgumentType dtype=128
Healpix(4, True) <- nside=3; nside=0; nside=2**20
healpix_pool(torch.ones(192)) <- values=torch.ones(108); values=torch.ones(12)
Resample(Cubemap(4), Healpix(1)) <- mode='bicubic'; target='cube'
views(torch.zeros(1, 24, 48)) <- layout='dodecahedron'; layout=[(90, 0, 0)]; field_of_view=3.2;
    Shape layout=[(0.0, 0.0)]
# crown
CrownConv2d(3, 4)(crown()) <- crown=crown(DOUBLE); Shape crown=crown(torch.float32, 4); ArgumentType crown=VALUES
CrownConv2d(3, 4) <- in_channels=-3; stride=3
CrownConv3d(3, 4)(crown(torch.float32, 4)) <- crown=crown(DOUBLE, 4); ArgumentType crown=VALUES
from_crown(crown()) <- Shape crown=Crown(crown().row, crown().col);
    Shape crown=Crown(crown().col, crown().row.expand(2, -1, -1, -1, -1)); ArgumentType crown=VALUES
CrownBatchNorm2d(3)(crown()) <- crown=crown(DOUBLE); ArgumentType crown=VALUES
HexConv2d(3, 4)(VALUES) <- values=VALUES.double(); ArgumentType values=crown()
HexConv2d(3, 4) <- kernel_size=5; orientation='south'; stride=3
hex_group_conv2d(torch.zeros(1, 3, 6, 162), torch.zeros(4, 3, 6, 7)) <- Shape values=torch.zeros(1, 3, 162);
    Shape weight=torch.zeros(4, 3, 7)
# sweep
sweep()(torch.zeros(1, 4, 5, 162), rig()) <- seen=torch.ones(4, 162); Shape features=torch.zeros(1, 3, 5, 162);
    Shape seen=SEEN[:2, :162]; Shape rig=CameraRig.stack([rig(), rig()]);
    Shape rig=SphereSweep(3, 8, 0.5).tables(rig()); Shape rig=SphereSweep(2, 9, 0.5).tables(rig());
    ArgumentType rig=camera()
SphereSweep(2, 8, 0.5) <- num_hypotheses=1; num_hypotheses=8.5; num_hypotheses=10 ** 9; min_depth=0.0; min_depth=NAN;
    level=-1; ArgumentType min_depth='near'
PanoramaSweep((4, 8), 4, 0.5)(torch.zeros(3, 4, 3, 12, 12), rig()) <- Shape features=torch.zeros(1, 3, 3, 12, 12);
    Shape rig=CameraRig.stack([rig(), rig()])
photo_consistency(IMAGES, rig(), 8, 0.5) <- level=4; seen=SEEN.float(); min_depth=0.0;
    Shape sphere_images=torch.zeros(2, 3, 642)
correlation_evidence(IMAGES[:, :2], pair()) <- level=2; Shape images=IMAGES[0]; Shape images=IMAGES[:, :1];
    Shape seen=SEEN[0]; Shape tables=SweepTables(*(x.expand(3, *x.shape) for x in pair()))
photo_consistency_share(torch.zeros(1, 642), IMAGES, rig(), 9, 0.5) <- Shape index=torch.zeros(1, 2562);
    Shape rig=semi_global_tables(rig(), 9, 0.5, 2)
semi_global_sweep(IMAGES, rig(), 8, 0.5) <- cost_level=4; substeps=0; level=11; small_penalty=5.0; seen=SEEN.byte();
    Shape sphere_images=IMAGES[:, :1];
    Shape sphere_images=torch.zeros(1, 2, 3, 642)[0]; Shape seen=torch.ones(3, 642) > 0;
    Shape rig=semi_global_tables(rig(), 8, 0.5, 2)
semi_global_smoothing(torch.zeros(1, 4, 42), 0.1, 0.1) <- small_penalty=0.5; contrast=0.0;
    Shape cost=torch.zeros(1, 4, 42)[0]; Shape guide=torch.zeros(1, 3, 162)
inverse_depth_hypotheses(8, 0.5) <- num_hypotheses=2.5; min_depth=5e-324; min_depth=1e10
# models
net()(torch.zeros(1, 4, 3, 2562), rig()) <- images=torch.zeros(1, 4, 3, 2562).double();
    Shape images=torch.zeros(1, 3, 3, 2562); ArgumentType rig=None
save_weights(net(), 'net.safetensors') <- path='net.pth'; bits=12
IcoSweepNet(3) <- volume_channels=0; aggregation='median'; level=30; level=1; num_hypotheses=1; min_depth=-1.0;
    num_cameras=0
OmniMVS(8) <- output_size=(160, 600); output_size=(33, 64); num_hypotheses=15; in_channels=2; aggregation='sum';
    norm='layer'; num_scales=0
RomniStereo(16) <- output_size=(15, 64); num_hypotheses=14; num_hypotheses=17; iterations=0; in_channels=2
# metrics
DepthIndexError(8).update(torch.zeros(1, 5), torch.zeros(1, 5)) <- Shape mask=torch.ones(5, dtype=torch.bool);
    Shape weights=torch.ones(4)
SolidAngleMean(Equirectangular(4, 8)).update(torch.zeros(2, 4, 8)) <- Shape values=torch.zeros(1, 8, 4);
    Shape mask=torch.ones(1, 4, 8)
SolidAngleIoU(ico(), 2).update(LABELS, LABELS) <- pred=LABELS + 0.5; target=LABELS.float(); target=LABELS + 7
evaluation_mask(rig(), DIRECTIONS, torch.zeros(1, 1)) <- Shape inverse_depth=torch.zeros(1);
    Shape valid=torch.ones(2, 1)
# losses
depth_index_huber(torch.zeros(1, 5), torch.zeros(1, 5)) <- delta=-1.0; Shape weights=torch.ones(4);
    Shape target_index=torch.zeros(2, 1, 5); Shape mask=torch.ones(5, dtype=torch.bool)
# data
split_frames('omnithings', 'train') <- split='test'; dataset='kitti'; protocol='mine'
write_ground_truth('1.png', torch.zeros(2, 4), 0.55) <- path='1.exr'; Shape inverse_depth=torch.zeros(1, 2, 4)
write_image('a.png', torch.zeros(3, 4, 6)) <- Shape image=torch.zeros(4, 6);
    Shape image=np.zeros((4, 6, 2), np.uint8); Shape image=np.zeros((4, 6, 4), np.uint8)
write_pages('a.png', [np.zeros((4, 6), np.uint8)]) <- Shape pages=[np.zeros((4, 6, 2), np.uint8)];
    Shape pages=[np.zeros((4, 6, 4), np.uint8)]
collate_samples([{'a': 1}]) <- samples=[{'a': 1}, {'b': 2}]; samples=[]; ArgumentType samples=[3]
RandomYaw(Icosphere(1)) <- p=2.0; angles='exact'; kinds={'flow': 'vectors'}
RotateFisheye() <- mode='depth'; Shape rotation=torch.eye(4)
SampleView(1) <- level=-1; Shape panorama=(10, 30)
truth_from_points(torch.ones(3, 3), ico()) <- points=torch.full((3, 3), NAN); gap=-1.0; Shape points=torch.ones(4)
# scenes
CameraDisturbance() <- vignetting=1.5; noise=-1.0
make_scene() <- kind='moon'; scale=0.0; clear_radius=2.0; ArgumentType seed='a'
render_rig(make_scene('bare'), rig()) <- ArgumentType scene=None; ArgumentType rig=camera()
World(rig(), carrier='pole') <- kind='street'; min_depth=0.0; tilts=(0.4, 0.1); tilts=(-0.3, 0.8)
WorldSamples(World(rig()), SampleView(1), range(1)) <- seeds=range(0); seeds=range(-1, 1);
    seeds=range(10_000_000, 10_000_001)
# viz
rig_picture(rig()) <- rig=CameraRig.stack([rig(), rig()]); ArgumentType rig=camera()
save_point_cloud('x.ply', DIRECTIONS, DIRECTIONS) <- path='x.doc'; points=torch.tensor([[NAN, 0.0, 0.0]]);
    Shape colors=torch.zeros(5, 3); ArgumentType points=POINTS
icosphere_mesh(torch.ones(42)) <- Shape colors=torch.ones(42, 3); ArgumentType depth=5
sphere_mesh(torch.ones(42)) <- Shape values=torch.ones(2, 42); ArgumentType values=ico()
rgb_panorama(rig(), pictures(torch.zeros(3, 24, 24)), 16) <- images={}; Shape depth=torch.ones(8, 16)
depth_to_color(torch.ones(2), 0.5, 2.0) <- min_depth=2.0; min_depth=NAN; min_depth=0.0
# capture
Predictor(rig(), net()) <- rig=rig().subset(['cam1']); rig=CameraRig([camera()] * 2, EYES.repeat(2, 1, 1));
    min_depth='near'; min_depth=True; min_depth=NAN; level=50; device='gpu'; method='magic';
    rig=rig().subset([0, 1, 2]); ArgumentType rig=camera()
sees(blank()) <- images=3; images=pictures('a.png'); images=pictures(torch.empty(3, 24, 24, device='meta'));
    images={'cam1': torch.zeros(3, 24, 24)}; images=pictures(torch.full((3, 24, 24), 200.0));
    images=pictures(torch.full((3, 24, 24), NAN)); images=blank() | {'left': IMAGE};
    images=pictures(torch.zeros(24, 24, dtype=torch.int64)); Shape images=pictures(torch.zeros(3, 5, 24));
    Shape images=blank() | {'cam3': torch.zeros(1, 3, 24, 24)}
sees(blank()).points() <- voxel=0.0; min_confidence=50
sees(blank()).camera('cam2') <- camera='cam9'; world_from_camera=torch.eye(4); world_from_camera=1000 * torch.eye(4);
    Shape world_from_camera=torch.eye(4)[:3]
calibrate_photometry(rig(), pictures(torch.zeros(3, 24, 24))) <- images={'cam1': IMAGE}; depth=-1;
    Shape images=pictures(torch.zeros(3, 8, 8))
find_own_body(rig(), []) <- frames=[{'cam1': torch.zeros(3, 24, 24)}]; margin=-1;
    Shape frames=[pictures(torch.zeros(3, 8, 8))]
align_rig_direct(rig(), blank(), DIRECTIONS, torch.ones(1)) <- rig=rig().subset([0]); images={'cam1': IMAGE};
    iterations=0; rig=at_once(); Shape inverse_depth=torch.ones(7); Shape weights=torch.ones(7);
    Shape directions=DIRECTIONS[None]
Hint.of_views(Views(pictures(torch.ones(1, 24, 24)), rig())) <- Shape views=Views(blank(), rig());
    ArgumentType views=torch.ones(4, 1, 5, 5)
Hint.of_points(torch.ones(5, 3)) <- weight=3.0; points=INTEGERS; fit='affine'; Shape points=torch.ones(5, 2)
Hint.of_directions(torch.ones(5, 3), torch.ones(5)) <- Shape inverse_depth=torch.ones(4);
    Shape weight=torch.ones(2, 8); ArgumentType weight=np.ones((8, 2)); ArgumentType directions=POINTS;
    ArgumentType inverse_depth=POINTS
Hint.of_depth(sees(blank()), torch.eye(4)) <- pose=2 * torch.eye(4); pose=torch.eye(4).roll(1);
    Shape pose=torch.eye(3); ArgumentType depth=torch.ones(5)
refine(camera(), BOARD, torch.ones(2, 6, 2)) <- fixed=('f',); camera=EquirectangularCamera((100, 200));
    Shape pixels=torch.ones(2, 5, 2)
refine_rig(rig(), BOARD, torch.ones(2, 4, 6, 2)) <- intrinsics=('omega',); Shape pixels=torch.ones(2, 3, 6, 2)
"""
"""A right call <- values of its arguments that are wrong, and the type of the error if it is not ``ArgumentError``."""
MISUSES = r"""
# cameras
pinhole(torch.ones(2).half()) -> dtype: Argument
PinholeCamera.from_field_of_view((8, 8), (1.0,)) -> field_of_view: ArgumentType
PinholeCamera(torch.ones(3, 2), torch.ones(2, 2), SIZE) -> intrinsics: Shape
KannalaBrandtCamera(F, C, None, SIZE) -> distortion: Argument
DoubleSphereCamera(F, C, 0.0, 2.0, SIZE) -> alpha: Argument
FisheyeCamera.stack([]) -> cameras: Argument
FisheyeCamera.from_field_of_view(SIZE, 3.84, 'orthographic') -> field_of_view: Argument
FisheyeCamera.stack([camera()] * 3).project(torch.zeros(2, 7, 3)) -> points or pixels: Shape
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
undistorted_camera(camera(), 1.0, 40.0) -> field_of_view, focal_length, balance: Argument
convert(EquirectangularCamera((32, 64)), 'ocam') -> to: Argument
project_pinhole(DIRECTIONS, [1.0, 1.0], torch.ones(2)) -> focal_length: ArgumentType
field_of_view(3) -> camera: ArgumentType
undistort(IMAGE[0], camera(), 1.0) -> image: Shape
rectified_pairs(rig(), pairs=[('cam1', 'left')]) -> cameras: Argument
rectified_pairs(at_once(), pairs=[('cam1', 'cam2')]) -> pairs: Argument
rectified_pairs(CameraRig([pinhole()] * 2, ring_rig(2).world_from_camera), pairs=[('cam1', 'cam2')]) -> pairs: Argument
rectified_pairs(rig())[0].rectify({'cam1': IMAGE}) -> images: Argument
rectified_pairs(rig())[0].rectify(list(blank().values())) -> images: Argument
read_camera(3) -> path: ArgumentType
rig().subset(['front']) -> cameras: Argument
rig().permuted([0, 1, 2, 2]) -> order: Argument
rig().resized({'front': (20, 24)}) -> image_size: Argument
CameraRig.stack([rig(), CameraRig(rig().cameras, rig().world_from_camera, around=['cam1'])]) -> rigs: Argument
CameraRig.stack([rig(), CameraRig({**rig().cameras, 'cam1': pinhole()}, rig().world_from_camera)]) -> rigs: Argument
Trajectory(['a', 'b'], EYES.repeat(2, 1, 1)).rig(camera(), [0, 2]) -> numbers: Argument
Trajectory(['0.0', '0.1', '0.2'], EYES.repeat(3, 1, 1)).of_images(['000', '001']) -> images: Argument
read_trajectory('none.txt') -> none.txt: MissingFile
read_trajectory('.') -> .: MissingFile
rig().project(DIRECTIONS[0]) -> points: Shape
read_rig(3) -> path: ArgumentType
remap(BYTES, camera(), camera(), mode='nearest', fill=-1) -> fill: Argument
seen_by(ring_rig(4), torch.tensor([[0.0, -1.0, 0.0]]), -torch.ones(1)) -> inverse_depth: Argument
to_kornia(PinholeCamera([500.0, 510.0], [319.5, 239.5], (480, 640), skew=2.5)) -> camera: Argument
to_kornia(DoubleSphereCamera(F, C, -0.2, 0.6, SIZE)) -> camera: Argument
to_kornia(KannalaBrandtCamera(F, C, [0.01] * 6, SIZE)) -> camera: Argument
overlap(torch.ones(2, 4).int(), torch.ones(3)) -> solid_angles: Shape
BrownConradyCamera(F, C, [0.0] * 6, SIZE) -> distortion: Argument
Remap(camera(), camera())(IMAGE[0]) -> image: Shape
fit_inverse_polynomial(OCamCamera([-9.0, 0.0, 0.01], None, C, [1, 0, 0], SIZE), 18) -> degree: Argument
CameraModule(camera(), fixed=['focus']) -> fixed: Argument
# geometry
bilinear_sample(torch.zeros(2, 3, 4, 4), torch.zeros(3, 5, 2)) -> image and pixels: Shape
bilinear_sample(IMAGE, torch.zeros(2, 2), padding='wrap') -> padding: Argument
transform_from_quaternion(torch.zeros(4), torch.zeros(3)) -> quaternion: Argument
# icosphere
icosphere_vertex_parents(0) -> level: Argument
ico().nearest(torch.tensor([NAN, 0.0, 1.0])) -> directions: Argument
Icosphere(1).locate(torch.zeros(4, 3, dtype=torch.long)) -> directions: Argument
Icosphere(1).sample(torch.zeros(1, 42), torch.ones(3)) -> directions: Shape
Icosphere(0).coarser() -> Icosphere.coarser: Argument
icosphere_pool(torch.ones(42), 'median') -> mode: Argument
icosphere_pool(torch.ones(12)) -> level: Argument
level_from_num_vertices('many') -> number of vertices: ArgumentType
level_from_num_vertices(43) -> number of vertices: Shape
icosphere_within(torch.ones(3), -0.1, 2) -> angle: Argument
icosphere_normals(torch.ones(43, 3)) -> number of vertices: Shape
IcospherePool(2)(torch.ones(1, 42)) -> values: Shape
icosphere_edges(-1) -> level: Argument
TriangleLocator(11) -> level: Argument
# sphere
Intake(rig().resized({'cam1': (16, 16)}), None) -> images: Shape
Equirectangular.with_square_pixels(5, 8) -> height, width: Argument
Equirectangular.with_square_pixels(2, 8).rows_of(torch.zeros(3, 8)) -> panorama: Shape
Equirectangular(10**7, 2 * 10**7) -> height, width: Argument
Equirectangular.with_square_pixels(10**6, 10**7) -> height, width: Argument
SphereConv2d(3, 4)(torch.zeros(1, 3, 8, 16, dtype=DOUBLE)) -> images: Argument
SphereConv2d(3, 8, 5)(torch.zeros(1, 3, 4, 8)) -> kernel_size: Argument
SphereConv2d(3, 8)(torch.zeros(1, 4, 8, 16)) -> images and weight: Shape
Cubemap(4).sample(torch.zeros(6, 4, 4), DIRECTIONS) -> values: Shape
Healpix(2).locate(torch.ones(1, 3), 'rings') -> interpolation: Argument
EquirectangularPad2d(-1) -> padding: Argument
CubePad2d(5)(torch.zeros(6, 3, 4, 4)) -> padding: Argument
sphere_taps((8, 16), stride=(0, 1)) -> stride: Argument
TangentImages(0, 5, margin=2) -> size: Argument
TangentImages(3, 10**6) -> base_level, size: Argument
TangentImages(40, 8) -> level: Argument
ring_from_nested(torch.ones(2), 4) -> ids: Argument
nested_from_ring(torch.ones(2).bool(), 4) -> ids: Argument
views(torch.zeros(3, 24, 48)).merge(quantity='range') -> quantity: Argument
views(torch.zeros(1, 24, 48)).merge(quantity='depth') -> quantity: Argument
Views([torch.zeros(3, 24, 24)] * 2, rig()) -> images: Argument
Views.of_pairs(rectified_pairs(rig()), [torch.zeros(24, 24)]) -> disparities: Argument
Views([torch.zeros(1, 24, 24)] * 4, rig()).merge(center=rig().center) -> center: Argument
# crown
CrownConv2d(5, 4)(crown()) -> crown: Shape
CrownConv2d(3, 5, stride=2)(to_crown(torch.zeros(1, 3, 12))) -> stride: Argument
CrownConv3d(3, 4, kernel_size=5) -> kernel_size: Argument
CrownConv3d(3, 5)(to_crown(torch.zeros(1, 3, 42))) -> crown: Shape
crown_relu(VALUES) -> crown: ArgumentType
exchange(VALUES) -> crown: ArgumentType
crown_max_pool2d(VALUES) -> crown: ArgumentType
CrownBatchNorm2d(4)(to_crown(torch.zeros(1, 3, 42))) -> crown: Shape
CrownPointwise(torch.nn.ReLU())(VALUES) -> crown: ArgumentType
CrownPointwise(torch.nn.Conv2d(3, 4, 1))(crown(DOUBLE)) -> crown: Argument
to_crown(VALUES[0]) -> values: Shape
CrownConvNorm2d(3, 4)(crown(DOUBLE)) -> crown: Argument
HexConv2d(4, 5)(torch.zeros(1, 3, 42)) -> values: Shape
HexConv2d(3, 5, orientation='north', level=2)(torch.zeros(1, 3, 42)) -> values: Shape
HexConv2d(3, 5, orientation='north') -> level: Argument
HexConv2d(3, 5, stride=2)(torch.zeros(1, 3, 12)) -> stride: Argument
HexConv3d(3, 4)(torch.zeros(1, 3, 4, 162).double()) -> values: Argument
HexConv3d(3, 5)(torch.zeros(1, 3, 42)) -> values: Shape
crown_conv2d(crown(), torch.zeros(4, 3, 7), torch.zeros(3)) -> bias: Shape
crown() + VALUES -> crown: ArgumentType
crown() + to_crown(torch.zeros(1, 3, 42)) -> crown: Shape
CrownAvgPool2d()(to_crown(torch.zeros(1, 3, 12))) -> stride: Argument
CrownMaxPool2d()(to_crown(torch.zeros(1, 3, 12))) -> stride: Argument
CrownMaxPool2d()(to_crown(torch.zeros(1, 3, 4, 42))) -> crown: Shape
# sweep
semi_global_sweep(IMAGES[:, :2], semi_global_tables(ring_rig(2), 9, 0.5, 3, substeps=1), 8, 0.5) -> rig: Argument
PanoramaSweep((8, 16), 8, 0.5).tables(camera()) -> rig: ArgumentType
PanoramaSweep((4, 8), 4, 0.5).tables(rig().resized({'cam1': (10, 10)})) -> rig: Argument
PanoramaSweep((4, 8), 4, 0.5).tables_for(VIEWS, PanoramaSweep((8, 16), 4, 0.5).tables(rig())) -> rig: Shape
soft_argmax(torch.zeros(8)) -> logits: Shape
Concatenation(3, 4)(SweepVolume(torch.zeros(1, 2, 3, 5, 6), torch.ones(1, 2, 5, 6) > 0)) -> volume: Shape
photo_consistency_share(torch.zeros(2, 642), torch.zeros(1, 4, 3, 10242), rig(), 9, 0.5) -> sphere_images: Shape
# models
net()(torch.zeros(1, 4, 3, 2562), ring_rig(3)) -> features: Shape
pretrained('resnet') -> name: Argument
SphereSegmenter('planar', 2) -> level: Argument
SemiGlobalSweep(4, 8, depth_coarsening=5) -> depth_coarsening: Argument
SemiGlobalSweep(3, 8).predict(IMAGES, rig(), hint=DepthHint(torch.ones(1, 42), torch.ones(1, 42))) -> hint: Argument
depth_error(torch.ones(1, 42), torch.ones(1, 42), max_depth=0.0) -> max_depth: Argument
ConstantDepth(3, 8, 0.5).fit(torch.ones(1, 1), torch.zeros(1, 1) > 0) -> inverse_depth: Argument
IcoSweepNet(3, feature_coarsening=3) -> coarsening: Argument
RefinedSweepNet(level=4) -> level: Argument
RefinedSweepNet.around(torch.nn.Identity()) -> prior: Argument
OmniMVS(output_size=(64, 64)) -> height, width: Argument
# metrics
error_of_surest(torch.zeros(2, 5), torch.zeros(2, 5), (0.0,)) -> shares: Argument
DepthIndexError(8).update(np.zeros((1, 3)), torch.zeros(1, 3)) -> pred_index: ArgumentType
DepthIndexError(0) -> num_hypotheses: Argument
DepthIndexError(8).update(torch.zeros(1, 5), torch.zeros(1, 6)) -> target_index: Shape
DepthError().update(torch.ones(1, 3), np.ones((1, 3))) -> target_depth: ArgumentType
DepthError(max_depth=0.0) -> max_depth: Argument
SolidAngleMean(3) -> grid: ArgumentType
SolidAngleIoU(ico(), 3, ignore_index=-1).update(LABELS.byte(), LABELS.byte() + 255) -> target: Argument
seam_mask(torch.tensor([[0.0, -1.0, 0.0]]), 0.0) -> angle: Argument
omnimvs_error(torch.zeros(1, 8, 24), torch.zeros(1, 8, 24)) -> pred_inverse_depth: Shape
omnimvs_error(torch.zeros(1, 8, 16), torch.zeros(1, 8)) -> target_inverse_depth: Shape
OmniMVSError(min_depth=0.0) -> min_depth: Argument
OmniMVSError().update(torch.zeros(1, 8, 16), torch.zeros(1, 8, 16), weights=torch.ones(128)) -> weights: Argument
ByRegion(DepthIndexError(8), {}) -> regions: Argument
ByRegion(DepthIndexError(8), {'seam': torch.ones(3)}).update(torch.zeros(1, 4), torch.zeros(1, 4)) -> prediction: Shape
left_right_error(torch.ones(2, 3), torch.ones(2, 3)) -> pred: Shape
# data
ocam_from_camera(EquirectangularCamera((100, 200))) -> camera: Argument
write_image('a.nonsense', torch.zeros(1, 4, 6)) -> a.nonsense: FileFormat
write_mask('a.png', torch.full((4, 6), 255)) -> mask: Argument
rotate_fivefold(torch.zeros(3, 100), 1) -> number of vertices: Shape
Mirror()({'fisheye': VIEWS, 'rig': rig()}) -> Mirror: Argument
Mirror()({'valid': LABELS, 'rig': CameraRig([camera()], EYES, {'cam1': torch.ones(SIZE) > 0})}) -> Mirror: Argument
collate_samples([{'images': {'a': IMAGE}}, {'images': {'a': IMAGE[:, 1:]}}]) -> images.a: Shape
random_rotations(-1) -> count: Argument
Compose([max, min]) -> transforms: ArgumentType
RandomYaw(Icosphere(1))({'normals': torch.rand(1, 2, 42)}) -> normals: Shape
RandomYaw(Icosphere(1))({'colour': torch.rand(1, 42)}) -> sample: Argument
RandomYaw(Icosphere(1)).inverse(torch.rand(1, 3, 42)) -> params: Argument
RandomYaw(Icosphere(1))({'image': torch.rand(2, 3, 42), 'depth': torch.rand(42)}) -> depth: Shape
RandomYaw(ico())({'images': VALUES, 'panorama_valid': torch.ones(4, 8), 'rig': rig()}) -> sample: Argument
RandomSphereRotation(Icosphere(1), max_angle=0.0) -> max_angle: Argument
RandomSphereRotation(ico())({'images': VALUES, 'panorama_valid': SEEN, 'rig': rig()}) -> sample: Argument
RotateFisheye()({'images': VALUES, 'rig': rig()}) -> RotateFisheye: Argument
RotateFisheye()({'images': {'cam1': IMAGE}, 'rig': rig()}) -> images: Argument
SampleView() -> view: Argument
RandomShift()({'images': VALUES, 'rig': rig()}) -> RandomShift: Argument
RotateFivefold(steps=1)({'panorama_valid': torch.ones(8, 16), 'rig': rig()}) -> panorama_valid: Argument
# scenes
pack([]) -> parts: Argument
pack([Part('cone', (0, 0, 3), (1, 1, 1))]) -> shape: Argument
pack([Part('box', (0, 0, 3), (1, 0, 1))]) -> half: Argument
trace(pack([Part('box', (0, 0, 3), (1, 1, 1))]), torch.zeros(3), torch.zeros(4, 2)) -> directions: Shape
ray_labels(MeshScene.__new__(MeshScene), torch.zeros(3), DIRECTIONS) -> scene: Argument
CameraDisturbance()({'images': IMAGES, 'rig': rig()}) -> CameraDisturbance: Argument
MeshScene(None, up='x') -> up: Argument
MeshScene(None, scale=0.0) -> scale: Argument
render_directions(make_scene('bare'), torch.zeros(3), POINTS) -> directions: ArgumentType
World(rig(), kind={'forest': 1.0}) -> shares: Argument
WorldSamples(World(ring_rig(4, 1.2)), SampleView(1), range(1)) -> rig: Argument
WorldSamples(World(rig().resized({'cam1': (20, 20)})), SampleView(images=True), range(1))[0] -> images: Shape
render_camera(make_scene(), camera(), torch.eye(4), samples_per_pixel=0) -> samples_per_pixel: Argument
# viz
angle_map(PinholeCamera([200.0, 200.0], [99.5, 99.5], (200, 200)), torch.zeros(3, 100, 200)) -> image: Shape
error_to_color(torch.ones(2), 0.0) -> max_error: Argument
sheet([np.zeros((2, 2, 3))]) -> picture: Shape
sheet([]) -> sheet: Argument
depth_panorama(torch.ones(1, 4, 8), 0.5) -> depth: Shape
coverage_panorama(CameraRig.stack([rig(), rig()])) -> rig: Argument
# capture
ToSphere(2).images(pictures(torch.full((3, 24, 24), 200.0)), rig()) -> images: Argument
Charuco(6, 4, 0.03, 0.04) -> marker: Argument
Charuco(20, 20, 0.04, 0.03) -> dictionary: Argument
Checkerboard(2, 5, 0.04) -> columns, rows: Argument
sees(blank()).mesh(max_depth=NAN) -> max_depth: Argument
predictor()(blank(), POINTS) -> hint: Argument
Preparation(photometric='yes') -> photometric: Argument
align_rig_direct(rig(), blank(), DIRECTIONS, torch.ones(2, 1)) -> images['cam1']: Shape
Hint.of_points(torch.zeros(5, 3)) -> hint: Argument
Hint.of_points(torch.full((5, 3), NAN)) -> hint: Argument
Hint.of_points(torch.zeros(0, 3)) -> hint: Argument
Hint.of_directions(torch.zeros(5, 3), torch.ones(5)) -> hint: Argument
Hint.of_views(Views(pictures(torch.zeros(1, 24, 24)), rig())) -> hint: Argument
Hint.of_views(Views(pictures(torch.zeros(1, 24, 24)), rig()), fit='affine') -> hint: Argument
Hint.of_views(Views(pictures(-torch.ones(1, 24, 24)), rig())) -> hint: Argument
refine(camera(), BOARD[:5], torch.ones(2, 5, 2)) -> pixels: Argument
register_aggregation('variance', Concatenation) -> aggregation: Argument
register_network('module', torch.nn.Linear) -> network: Argument
register_network('omnimvs', IcoSweepNet) -> network: Argument
register_camera(type('Other', (PinholeCamera,), {})) -> model: Argument
load_reference_checkpoint('absent.pth') -> absent.pth: MissingFile
net().with_changes(nonesuch=1) -> nonesuch: Argument
"""
"""A wrong call -> what the message begins with: the type of the error, ``ArgumentError`` or another."""


def rows(table: str, separator: str) -> Iterator[list[str]]:
    """The two sides of each row; a line that is indented belongs to the row above."""
    for row in re.sub(r"\n +", " ", table).strip().splitlines():
        if not row.startswith("#"):
            yield row.split(separator)


def changed(call: str, argument: str, value: str) -> None:
    """Make a call with another value of an argument."""
    names = names_in(f"{call}, {value}", MODULES) | globals()
    node = cast(ast.Call, ast.parse(call, mode="eval").body)
    function = eval(ast.unparse(node.func), names)
    bind = inspect.signature(function.forward if isinstance(function, torch.nn.Module) else function).bind
    bound = eval(
        f"bind{call.removeprefix(ast.get_source_segment(call, node.func) or '')}", names | {"bind": bind}
    )
    bound.arguments[argument] = eval(value, names)
    function(*bound.args, **bound.kwargs)


def is_told(wrong: Callable[[], object], argument: str, kind: str) -> None:
    with pytest.raises(getattr(core, f"{kind}Error")) as caught:
        wrong()
    beginning = str(caught.value).partition(": ")[0]
    assert argument in (beginning, *re.findall(r"\w+", beginning))
    assert len(str(caught.value)) < 700
    assert not list(Path().iterdir())


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is written, but if it were."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(("call", "error"), rows(MISUSES, " -> "))
def test_misuse_is_told_in_our_own_words(call: str, error: str) -> None:
    is_told(lambda: eval(call, names_in(call, MODULES) | globals()), *error.split(": "))


@pytest.mark.parametrize(
    ("call", "change"),
    [(call, each) for call, changes in rows(CHANGES, " <- ") for each in changes.split("; ")],
)
def test_a_wrong_value_is_told_by_the_name_of_its_argument(call: str, change: str) -> None:
    kind, argument, value = re.fullmatch(r"(?:(\w+) )?(\w+)=(.*)", change).groups("Argument")
    is_told(lambda: changed(call, argument, value), argument, kind)


@pytest.mark.parametrize("call", [call for call, _ in rows(CHANGES, " <- ")])
def test_calls_are_right_before_they_are_changed(call: str) -> None:
    eval(call, names_in(call, MODULES) | globals())


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
