# SPDX-License-Identifier: Apache-2.0
"""Small sets with scanned truth in the layouts of published ones, of a rendered room."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation
from torch import Tensor

from sphericalvision.cameras import (
    CameraRig,
    EquirectangularCamera,
    FisheyeCamera,
    KannalaBrandtCamera,
    read_camera,
    ring_rig,
)
from sphericalvision.data.scanned.helvipad import BASELINE, HELVIPAD_LATITUDES
from sphericalvision.data.scanned.spires import OURS_FROM_LIDAR
from sphericalvision.geometry import invert_transform, transform_from_axis_angle, transform_points
from sphericalvision.io.images import write_image, write_pages
from sphericalvision.scenes import Scene, make_scene, ray_depth, render_camera, render_rig
from sphericalvision.sphere import Equirectangular
from tests.data.test_truth import lidar, scan, write_pcd

SIZE = (64, 240)
SCENE = make_scene("room", seed=3)
ROAD = make_scene("outdoors", seed=4)
SEQUENCE = "2013_05_28_drive_0000_sync"
SITE = "2024-03-13-observatory-quarter-01"
RAYS = lidar(lines=64, columns=360)


def write_helvipad(root: Path, splits: tuple[str, ...] = ("train", "val", "test")) -> Path:
    """A frame for each split, sixteen times smaller than the original."""
    grid = Equirectangular(*SIZE, latitudes=HELVIPAD_LATITUDES)
    camera = EquirectangularCamera(SIZE, latitudes=HELVIPAD_LATITUDES)
    depth = ray_depth(SCENE, torch.zeros(3), grid.directions)
    stored = (depth * 256).round().numpy().astype(np.uint16)
    stored[:, ::7] = 0
    for split in splits:
        folder = root / split
        for name, height in (("bottom", 0.0), ("top", -BASELINE)):
            pose = torch.eye(4)
            pose[1, 3] = height
            path = folder / f"images_{name}" / "20240120_REC_06_IN" / "0042.jpg"
            write_image(path, render_camera(SCENE, camera, pose, samples_per_pixel=1))
        write_pages(folder / "depth_maps" / "20240120_REC_06_IN" / "0042.png", [stored])
        augmented = (depth * 256).round().numpy().astype(np.uint16)
        write_pages(folder / "depth_maps_augmented" / "20240120_REC_06_IN" / "0042.png", [augmented])
    return root


def in_lidar(where: Tensor, pose: Tensor, scene: Scene = SCENE) -> Tensor:
    """What a LiDAR at a place sees, in its own frame, of which ``pose`` is world from LiDAR."""
    return transform_points(invert_transform(pose), scan(scene, where, rays=RAYS))


def write_spires(root: Path) -> Path:
    """Two clouds and images of three fisheyes, of which one has no image at its time."""
    pose = invert_transform(OURS_FROM_LIDAR)  # LiDAR from ours: the LiDAR stands at the world's origin
    cameras, camera = [], KannalaBrandtCamera([24.0, 24.0], [29.5, 19.5], [0.0] * 4, (40, 60), max_angle=1.4)
    rig = ring_rig(4, image_size=(8, 8)).world_from_camera[[0, 3, 1]]
    for k, world_from_camera in enumerate(rig):
        camera_from_lidar = invert_transform(pose @ world_from_camera)
        q = Rotation.from_matrix(camera_from_lidar[:3, :3].double().numpy()).as_quat()  # x, y, z, w
        cameras.append(
            {
                "label": f"camera_{k}",
                "image_width": 60,
                "image_height": 40,
                "intrinsics": [24.0, 24.0, 29.5, 19.5],
                "extra_params": [0.0, 0.0, 0.0, 0.0],
                "T_cam_lidar_t_xyz_q_xyzw": [*camera_from_lidar[:3, 3].tolist(), *q.tolist()],
            }
        )
        for stamp in ("1700000000.010000000", "1700000001.900000000"):
            image = render_camera(SCENE, camera, world_from_camera, samples_per_pixel=1)
            write_image(root / "sequences" / SITE / "raw" / f"cam{k}" / f"{stamp}.jpg", image)
    sensor = {"sensor": {"camera_model": "OPENCV_FISHEYE", "camera_fov": 160, "cameras": cameras}}
    (root / "sensor.yaml").write_text(yaml.safe_dump(sensor))
    clouds = root / "sequences" / SITE / "processed" / "vilens-slam" / "undist-clouds"
    clouds.mkdir(parents=True)
    for stamp in ("1700000000_000000000", "1700000001_000000000"):
        write_pcd(clouds / f"cloud_{stamp}.pcd", in_lidar(torch.zeros(3), OURS_FROM_LIDAR).numpy(), "binary")
    return root


MEI = """%YAML:1.0
---
model_type: MEI
camera_name: {name}
image_width: 48
image_height: 48
mirror_parameters:
   xi: 1.5
distortion_parameters:
   k1: 0.0
   k2: 0.0
   p1: 0.0
   p2: 0.0
projection_parameters:
   gamma1: 60.0
   gamma2: 60.0
   u0: 23.5
   v0: 23.5
"""
AXES = torch.tensor([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Ours from the vehicle: x forward, y right, z down."""


def bend(frame: float) -> Tensor:
    """World from the vehicle, 30 cm and 2° on from frame to frame."""
    ours = transform_from_axis_angle(
        torch.tensor([0.0, 0.035 * frame, 0.0]), torch.tensor([0.0, 0.0, 0.3 * frame])
    )
    return ours @ AXES


def turned(share: Tensor, frame: float, velo_from_pose: Tensor) -> Tensor:
    """What a scanner sees, in its own frame, ``share`` of a turn to its left: it looked there as much earlier."""
    azimuth = 2 * math.pi * share + torch.linspace(-1.5, 1.5, 4).deg2rad()
    elevation = torch.linspace(-45, 45, 64).deg2rad()[:, None]
    x, y = elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin()
    rays = torch.stack((x, y, elevation.sin().expand_as(x)), -1).view(-1, 3)
    velo = bend(frame - float(share)) @ invert_transform(velo_from_pose)
    return rays * ray_depth(SCENE, velo[:3, 3], rays @ velo[:3, :3].T)[:, None]


def write_kitti360(root: Path) -> Path:
    """Three poses of a bend, two fisheyes to the sides, a scanner above and behind that turns clockwise."""
    (root / "calibration").mkdir(parents=True)
    for name in ("image_02", "image_03"):
        (root / "calibration" / f"{name}.yaml").write_text(MEI.format(name=name))
    camera = read_camera(root / "calibration" / "image_02.yaml")
    left, right = ring_rig(4, radius=0.3, image_size=(8, 8)).world_from_camera[[3, 1]]
    pose_from = {
        f"image_0{k}": invert_transform(AXES) @ p for k, p in ((0, torch.eye(4)), (2, left), (3, right))
    }
    pose_from["image_01"] = pose_from["image_00"]
    text = "".join(f"{name}: {row(pose_from[name])}\n" for name in sorted(pose_from))
    (root / "calibration" / "calib_cam_to_pose.txt").write_text(text)
    velo_from_pose = torch.tensor([[1.0, 0, 0, 0.1], [0, -1, 0, 0], [0, 0, -1, 0.2], [0, 0, 0, 1]])
    (root / "calibration" / "calib_cam_to_velo.txt").write_text(
        row(velo_from_pose @ pose_from["image_00"]) + "\n"
    )
    lines = []
    for frame in (5, 6, 7):
        world_from_pose = bend(frame - 6)
        lines.append(f"{frame} {row(world_from_pose)}\n")
        for name in ("image_02", "image_03"):
            path = root / "data_2d_raw" / SEQUENCE / name / "data_rgb" / f"{frame:010d}.png"
            write_image(
                path, render_camera(SCENE, camera, world_from_pose @ pose_from[name], samples_per_pixel=1)
            )
        points = torch.cat(
            [turned(share, frame - 6, velo_from_pose) for share in (torch.arange(90) + 0.5) / 90 - 0.5]
        )
        path = root / "data_3d_raw" / SEQUENCE / "velodyne_points" / "data" / f"{frame:010d}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        torch.cat((points, points[:, :1]), 1).numpy().astype("<f4").tofile(path)
    (root / "data_poses" / SEQUENCE).mkdir(parents=True)
    (root / "data_poses" / SEQUENCE / "poses.txt").write_text("".join(lines))
    return root


def row(pose: Tensor) -> str:
    return " ".join(f"{value:.9g}" for value in pose[:3].flatten().tolist())


def write_omnipus(root: Path) -> Path:
    """A case for training and one for the test, of one frame each."""
    camera = KannalaBrandtCamera([20.0, 20.0], [31.5, 17.5], [0.0] * 4, (36, 64), max_angle=math.pi / 2)
    poses = ring_rig(4, radius=0.1, image_size=(8, 8)).world_from_camera
    poses[:, :3, 3] += torch.tensor([0.2, -0.3, 0.1])  # the LiDAR is not in the middle of the cameras
    rig = CameraRig([camera] * 4, poses)
    (root / "calibration").mkdir(parents=True)
    for k, world_from_camera in enumerate(rig.world_from_camera, 1):
        pose = invert_transform(OURS_FROM_LIDAR) @ world_from_camera
        angles = Rotation.from_matrix(pose[:3, :3].double().numpy()).as_euler("xyz").tolist()
        keys = ("roll", "pitch", "yaw", "x", "y", "z")
        values = dict(zip(keys, (*angles, *pose[:3, 3].tolist()), strict=True))
        content = {
            "intrinsic_parameters": [{"fx": 20.0}, {"fy": 20.0}, {"cx": 31.5}, {"cy": 17.5}],
            "distortion_parameters": [{f"k{i}": 0.0} for i in (1, 2, 3, 4)],
            "extrinsic_parameters": [{key: value} for key, value in values.items()],
            "image_height": 36,
            "image_width": 64,
        }
        (root / "calibration" / f"cam{k}.yaml").write_text(yaml.safe_dump(content))
    depth = ray_depth(SCENE, rig.center, Equirectangular(160, 640, max_latitude=math.pi / 4).directions)
    images = render_rig(SCENE, rig, samples_per_pixel=1)
    for case in (1, 2):
        folder = root / "omnipusa" / f"omnipusA_case{case}"
        for name, image in images.items():
            write_image(folder / f"resize_{name}" / "000000.png", image)
        write_pages(folder / "omnidepth_gt" / "000000.tiff", [(1 / depth).numpy()])
    return root


def write_deep360(root: Path, splits: tuple[str, ...] = ("training", "validation", "testing")) -> Path:
    """A frame for each split, eight times smaller, along the rays that the set's own formulas give."""
    size = (128, 64)
    theta = math.pi - (torch.arange(size[0]) + 0.5) * 2 * math.pi / size[0]
    phi = math.pi / 2 - (torch.arange(size[1]) + 0.5) * math.pi / size[1]
    theta, phi = torch.meshgrid(theta, phi, indexing="ij")
    left, up, forward = phi.sin(), phi.cos() * theta.sin(), phi.cos() * theta.cos()
    rays = torch.stack((-left, -up, forward), -1)
    depth = ray_depth(ROAD, torch.zeros(3), rays).clamp(max=1000.0).numpy()
    upright = EquirectangularCamera((256, 512))
    folders = [root / "ep1_500frames" / split for split in splits]
    for k, place in enumerate(((0.0, 0, 0), (1.0, 0, 0), (0.0, 0, -1), (1.0, 0, -1)), 1):
        pose = torch.eye(4)
        pose[:3, 3] = torch.tensor(place)
        panorama = render_camera(ROAD, upright, pose, samples_per_pixel=1)
        image = upright.sample(panorama, rays.view(-1, 3))[0].view(3, *size)
        for folder in folders:
            write_image(folder / "rgb" / f"002505_{12 if k < 3 else 34}_rgb{k}.png", image)
    for folder in folders:
        (folder / "depth").mkdir()
        np.savez(folder / "depth" / "002505_depth.npz", depth)
    return root


SCENES = ("001_057_000", "002_010_000")
WIDE = FisheyeCamera(
    "equidistant", [64 / math.radians(195)] * 2, [31.5, 17.5], (36, 64), math.radians(195 / 2)
)


def write_widedepth(root: Path) -> Path:
    """Two scenes of 195° and 65 mm, 32 times smaller; the second has no camera below."""
    rays = WIDE.unproject(WIDE.pixel_grid()).directions
    depth = ray_depth(SCENE, torch.zeros(3), rays)
    for scene in SCENES:
        folder = root / scene / "195FOV" / "65mm"
        for name, place in (("CENTER", (0.0, 0)), ("RIGHT", (0.065, 0)), ("DOWN", (0, 0.065))):
            pose = torch.eye(4)
            pose[:2, 3] = torch.tensor(place)
            if name != "DOWN" or scene == SCENES[0]:
                write_image(
                    folder / name / "fisheye.png", render_camera(SCENE, WIDE, pose, samples_per_pixel=1)
                )
        stored = (depth * 1000).round().numpy().astype(np.uint16)
        stored[:, ::9] = 0
        write_pages(folder / "CENTER" / "depth" / "fisheye.png", [stored])
    return root


PUBLISHED = (write_deep360, write_helvipad, write_kitti360, write_omnipus, write_spires, write_widedepth)
"""Writers of published sets, each called by the set's name."""


def write_own(root: Path, rig: CameraRig, frames: tuple[str, ...], scene: Scene = SCENE) -> Path:
    """Images, a scan for each frame, the rig, and the pose of the scanner above it."""
    pose = torch.tensor([[0.0, -1, 0, 0.1], [0, 0, -1, -0.3], [1, 0, 0, 0.0], [0, 0, 0, 1]])
    rig.to_yaml(root / "rig.yaml")
    (root / "lidar.txt").write_text(row(pose) + "\n")
    (root / "scans").mkdir()
    images = render_rig(scene, rig, samples_per_pixel=1)
    for frame in frames:
        for name, image in images.items():
            write_image(root / name / f"{frame}.png", image)
        np.save(root / "scans" / f"{frame}.npy", in_lidar(pose[:3, 3], pose).numpy())
    return root
