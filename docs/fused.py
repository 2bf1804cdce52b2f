# SPDX-License-Identifier: Apache-2.0
"""A made-up capture by a moving rig, its frames fused into one cloud, and how near that is to what is there.

Run from the root of the repository: ``python docs/fused.py FOLDER [room|corridor|...]``, two minutes. It writes the
capture (images, ``rig.yaml``, ``poses.txt``), what ``sphericalvision-predict outputs=[cloud,fused]`` makes of it, and
``fused.png``: one frame, all frames, one point of these for each cube, and the fused cloud, seen from beside the way of
the rig.
"""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig, save_rig
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.io.images import write_image
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.sphere import Equirectangular

FRAMES, SEED = 16, 10_100_003
NEAR = 0.05
"""Metres from what is there, within which a point is right."""
ROWS = 320


def write_capture(folder: Path, kind: str) -> Tensor:
    """A rig of two fisheyes back to back on a way in the shape of an eight; returns what there is to see ``(n, 3)``."""
    scene, rig = make_scene(kind, seed=SEED), ring_rig(2, radius=0.1, image_size=(256, 256))
    save_rig(rig, folder / "rig.yaml")
    lines, seen = [], []
    for frame in range(FRAMES):
        turn = 2 * math.pi * frame / FRAMES
        place = torch.tensor([0.5 * math.cos(turn) - 0.25, 0.0, 0.5 * math.sin(2 * turn) / 2])
        half = 0.15 * math.sin(turn)  # of the angle about the vertical
        lines.append(
            f"{frame / 10:.2f} {' '.join(map(str, place.tolist()))} 0 {math.sin(half)} 0 {math.cos(half)}"
        )
        pose = transform_from_axis_angle(torch.tensor([0.0, 2 * half, 0.0]), place)
        at = CameraRig(rig.cameras, pose @ rig.world_from_camera)
        for name, image in render_rig(scene, at).items():
            write_image(folder / name / f"{frame / 10:.2f}.png", image)
        if frame % 4 == 0:
            rays = Equirectangular(512, 1024).directions.flatten(0, 1)
            depth = ray_depth(scene, place, rays)
            there = depth < 30
            seen.append(place + rays[there] * depth[there, None])
    (folder / "poses.txt").write_text("\n".join(lines))
    return torch.cat(seen)


def picture(points: Tensor, colors: Tensor) -> Tensor:
    """``(3, h, w)``: points as squares in a panorama from beside the way, the nearest in front."""
    rays = points - torch.tensor([0.9, -0.3, -0.4])
    distance = rays.norm(dim=-1)
    grid = Equirectangular(ROWS, 2 * ROWS)
    cells = grid.nearest(rays / distance[:, None])
    shown = torch.ones(ROWS * 2 * ROWS, 3)
    order = distance.argsort(descending=True)
    for step in (0, 1, 2 * ROWS, 2 * ROWS + 1):
        shown[(cells[order] + step).clamp(max=len(shown) - 1)] = colors[order]
    return shown.view(ROWS, 2 * ROWS, 3).movedim(-1, 0)


def main(folder: Path, kind: str = "room") -> None:
    """Write everything, and print a line for each cloud."""
    there = write_capture(folder, kind)
    keys = ("calibration=rig.yaml", "images={camera}/{frame}.png", "poses=poses.txt", "outputs=[cloud,fused]")
    command = (str(Path(sys.executable).with_name("sphericalvision-predict")), *keys, "output=out")
    subprocess.run(command, cwd=folder, check=True)
    surface, some = cKDTree(there.numpy()), there[:: len(there) // 10_000].numpy()
    frames = [trimesh.load(path) for path in sorted((folder / "out").glob("*_points.ply"))]
    points = np.concatenate([np.asarray(frame.vertices) for frame in frames])
    cubes = np.floor(points / np.load(folder / "out/fused.npz")["side"])
    colors = np.concatenate([frame.visual.vertex_colors for frame in frames])
    first = np.unique(cubes, axis=0, return_index=True)[1]
    clouds = {
        "one frame": frames[len(frames) // 2 :][:1],
        "all frames": frames,
        "a point a cube": [trimesh.PointCloud(points[first], colors=colors[first])],
        "fused": [trimesh.load(folder / "out/fused.ply")],
    }
    shown = []
    print(f"\n{'':14}  points   within {100 * NEAR:.0f} cm   mean error   of what is there, found")
    for name, parts in clouds.items():
        points = np.concatenate([np.asarray(part.vertices) for part in parts])
        colors = np.concatenate([part.visual.vertex_colors[:, :3] for part in parts]) / 255
        error = surface.query(points[:: len(points) // 10_000])[0]
        found = cKDTree(points).query(some, distance_upper_bound=NEAR)[0] < NEAR
        line = f"{(error < NEAR).mean():13.0%} {100 * error.mean():9.1f} cm {found.mean():25.0%}"
        print(f"{name:14} {len(points):7} {line}")
        shown.append(picture(torch.from_numpy(points).float(), torch.from_numpy(colors).float()))
    write_image(folder / "fused.png", torch.cat(shown, 1))


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("usage: python docs/fused.py FOLDER [kind of scene]")
    main(Path(sys.argv[1]), *sys.argv[2:3])
