# SPDX-License-Identifier: Apache-2.0
"""Data sets for Gaussian splatting: what they say of a ball around the rig, and what COLMAP and nerfstudio read."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from sphericalvision.cameras import (
    Camera,
    CameraRig,
    EquirectangularCamera,
    PinholeCamera,
    Remap,
    UnifiedCamera,
    read_rig,
    ring_rig,
)
from sphericalvision.capture.pinhole_twins import pinhole_twins
from sphericalvision.capture.result import Depth
from sphericalvision.capture.splat import SplatScene
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.io.images import read_image, read_mask, read_pages
from sphericalvision.models import WinnerTakesAll

BALL = 1.1
"""Metres: index 3.5 of 7 is twice the nearest depth."""


def ball(rig: CameraRig) -> Depth:
    """A ball around a rig, whose images are their own pixel coordinates."""
    net = WinnerTakesAll(4, 8, depth_coarsening=0)
    ones = torch.ones(2562)
    images = {}
    for name, camera in rig.cameras.items():
        height, width = camera.image_size
        grid = camera.pixel_grid(torch.float32).movedim(-1, 0) / torch.tensor([width, height])[:, None, None]
        images[name] = torch.cat((grid, grid[:1]))
    return Depth(3.5 * ones, ones, ones > 0, net, rig, images)


def distance_to_ball(
    camera: Camera, pose: torch.Tensor, center: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Metres along the ray of each pixel from a place in the ball, and the normal there in the camera's frame."""
    rays, _ = camera.to(torch.float64).unproject(camera.pixel_grid(torch.float64))
    start = pose[:3, :3].T @ (pose[:3, 3] - center)
    along = rays @ start
    distance = -along + (along.square() - start.square().sum() + BALL**2).sqrt()
    return distance, -(start + distance[..., None] * rays) / BALL


MIXED = ring_rig(3, 0.2, (88, 96), math.radians(200))
LENSES = {
    "fisheyes": MIXED,
    "unified": MIXED.replaced(
        {name: UnifiedCamera([60.0, 60.0], [47.0, 44.0], 1.0, None, (88, 96)) for name in MIXED.names}
    ),
    "pinholes": MIXED.replaced(
        {name: PinholeCamera([60.0, 62.0], [47.0, 44.0], (88, 96)) for name in MIXED.names}
    ),
    "panoramas": MIXED.replaced({name: EquirectangularCamera((48, 96)) for name in MIXED.names}),
}


@pytest.mark.parametrize("lens", LENSES)
def test_colmap_reads_it_and_points_are_where_images_show_them(lens: str, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    rig = LENSES[lens]
    scene, moments = SplatScene(tmp_path), {}
    for frame, right in (("000", 0.0), ("001", 0.1)):
        pose = transform_from_axis_angle(torch.tensor([0.0, right, 0.0]), torch.tensor([right, 0.0, 0.0]))
        moments[frame] = rig.replaced(world_from_camera=pose @ rig.world_from_camera)
        depth = ball(moments[frame])
        scene.add(frame, depth)
    cloud = depth.points()
    scene.close(cloud)
    assert not scene.notes
    kinds = sorted(path.name for path in tmp_path.iterdir())
    assert kinds == (["pinhole"] if lens == "pinholes" else ["native", "pinhole"])
    for kind in kinds:
        folder = tmp_path / kind
        binary = pycolmap.Reconstruction(str(folder / "sparse/0"))
        text = pycolmap.Reconstruction()
        text.read_text(str(folder / "sparse/0"))
        for model in (binary, text):
            assert (model.num_rigs(), model.num_frames()) == (1, 2)
            assert model.num_points3D() == len(cloud.points)
            sightings = 0
            for point in model.points3D.values():
                for sighting in point.track.elements:
                    image = model.images[sighting.image_id]
                    pixel = model.cameras[image.camera_id].img_from_cam(image.cam_from_world() * point.xyz)
                    gap = abs(pixel - image.points2D[sighting.point2D_idx].xy).max()
                    assert min(gap, abs(gap - 96)) < 0.01  # columns 0 and 96 of a panorama are one
                    sightings += 1
            assert sightings > len(cloud.points)
        points = np.stack([binary.points3D[number + 1].xyz for number in range(len(cloud.points))])
        np.testing.assert_allclose(points, cloud.points, atol=1e-6)
        np.testing.assert_allclose(trimesh.load(folder / "points3D.ply").vertices, cloud.points, atol=1e-6)
        if kind == "native":  # the lens that is written sends points where ours does
            for image in binary.images.values():
                name, frame = image.name.removesuffix(".png").split("/")
                ours = moments[frame].subset([name])
                local = np.array([image.cam_from_world() * xyz for xyz in points])
                expected, valid = ours.project(cloud.points)
                for row in np.flatnonzero(valid[0].numpy() & (local[:, 2] > 0.05))[::50]:
                    pixel = binary.cameras[image.camera_id].img_from_cam(local[row]) - 0.5
                    assert abs(pixel - expected[0, row].numpy()).max() < 0.5


@pytest.mark.parametrize("lens", LENSES)
def test_depth_and_normals_are_those_of_the_ball(lens: str, tmp_path: Path) -> None:
    rig = LENSES[lens]
    size = rig.cameras["cam1"].image_size
    masked = rig.replaced(masks={"cam1": torch.arange(size[1]).expand(size) > 20})
    scene = SplatScene(tmp_path)
    scene.add("7", ball(masked))
    scene.close(ball(masked).points())
    for kind in (path.name for path in tmp_path.iterdir()):
        folder = tmp_path / kind
        content = json.loads((folder / "transforms.json").read_text())
        again = read_rig(folder / "transforms.json", dtype=torch.float64)
        assert content["ply_file_path"] == "points3D.ply"
        for entry, camera, pose in zip(
            content["frames"], again.cameras.values(), again.world_from_camera, strict=True
        ):
            assert read_image(folder / entry["file_path"]).shape[1:] == camera.image_size
            mask = read_mask(folder / entry["mask_path"], camera.image_size)
            steps = torch.from_numpy(read_pages(folder / entry["depth_file_path"])[0].astype(np.float64))
            assert not steps[~mask].any()
            distance, normal = distance_to_ball(camera, pose, rig.center.double())
            if kind == "pinhole":
                distance = distance * camera.unproject(camera.pixel_grid(torch.float64)).directions[..., 2]
            known = steps > 0
            assert known.sum() > 0.8 * mask.sum()
            assert ((steps * content["depth_unit_scale_factor"] / distance - 1).abs()[known] < 0.02).all()
            shades = torch.from_numpy(read_pages(folder / entry["normal_file_path"])[0].astype(np.float64))
            assert ((2 * shades / 255 - 1 - normal).norm(dim=-1)[known] < 0.08).all()
            assert not shades[~known].any()
    if lens in ("unified", "pinholes"):
        kind = "native" if lens == "unified" else "pinhole"
        mask = read_mask(tmp_path / kind / "masks/cam1/7.png")
        assert not mask[:, :21].any()
        assert mask[40, 22:].all()


def test_twins_together_see_what_the_lens_sees() -> None:
    for camera in (*LENSES["fisheyes"].cameras.values(), EquirectangularCamera((48, 96))):
        directions = ball(MIXED).directions
        seen = camera.project(directions).valid
        by_twins = torch.zeros_like(seen)
        for twin in pinhole_twins(camera):
            by_twins |= twin.camera.project(directions @ twin.pose[:3, :3].float()).valid
        assert (seen & ~by_twins).float().mean() < 0.02
    (narrow,) = pinhole_twins(LENSES["pinholes"].cameras["cam1"])
    assert isinstance(narrow.remap, Remap)
    image = torch.rand(3, 88, 96)
    torch.testing.assert_close(narrow.remap(image), image, atol=1e-4, rtol=0)


def test_a_lens_that_no_model_holds_is_said(tmp_path: Path) -> None:
    panorama = MIXED.replaced({**MIXED.cameras, "cam2": EquirectangularCamera((48, 96))})
    scene = SplatScene(tmp_path)
    scene.add("", ball(panorama))
    assert "native is left out, pinhole has all cameras" in scene.notes[0]
    scene.close(ball(panorama).points())
    assert [path.name for path in tmp_path.iterdir()] == ["pinhole"]
    assert (tmp_path / "pinhole/images/cam2_back/0.png").is_file()


def test_the_lens_that_is_worst_in_the_model_of_all_is_said(tmp_path: Path) -> None:
    worst = UnifiedCamera([15.0, 15.0], [47.0, 44.0], 0.2, None, (88, 96))
    scene = SplatScene(tmp_path)
    scene.add("", ball(LENSES["unified"].replaced({**LENSES["unified"].cameras, "cam2": worst})))
    assert "which stands for cam2 in native, is off by up to 1.3 pixels" in scene.notes[0]
