# SPDX-License-Identifier: Apache-2.0
"""Rendered photographs with the faults of real ones, the depth estimated from them, and its points, in one picture.

``python docs/capture.py`` writes docs/images/capture.jpg; it takes half a minute. Four fisheyes stand at the corners of
a vehicle, which is in view and masked. Each loses light towards its edge, is a little out of focus, and has its own
exposure, white balance and noise. The scene is none of those that the network was trained on.

``python docs/capture.py film`` writes docs/images/drive.webp: the vehicle drives through another scene, and each frame
is estimated by itself. It takes two minutes.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from sphericalvision import Predictor
from sphericalvision.cameras import CameraRig, PinholeCamera
from sphericalvision.geometry import (
    invert_transform,
    transform_from_axis_angle,
    transform_points,
)
from sphericalvision.recipes.app.rigs import make_corner_rig
from sphericalvision.scenes import make_scene, render_rig
from sphericalvision.scenes.carriers import carrier_masks, with_carrier
from sphericalvision.scenes.disturbances import CameraDisturbance
from sphericalvision.sphere import Equirectangular
from sphericalvision.viz import depth_panorama, depth_to_color, rgb_panorama
from sphericalvision.viz.color import fade, near_end
from sphericalvision.viz.panorama import confidence_strength

OUTPUT = Path(__file__).parent / "images" / "capture.jpg"
KIND, SEED = "room", 10_100_004
SIDE = 400
"""Pixels of a fisheye image in the picture, whose width is four of them."""
TURN_DEG, TILT_DEG, VIEW_DEG, DISTANCE = 20.0, 50.0, 60.0, 4.6
"""The view of the points: turned about the vertical, tilted down, field of view, and metres from the rig."""
CEILING = -0.8
"""Metres along y, which points down: what is higher is left out of that view."""
JUMP = 0.08
"""Share by which inverse depth may differ between neighbours."""
FILM, FILM_KIND, FILM_SEED = OUTPUT.with_name("drive.webp"), "outdoors", 10_100_012
FRAMES, METRES, MILLISECONDS = 16, 0.9, 200
"""Of the film: how many, how far the vehicle drives in them, and how long each is shown."""
DISTURBANCE = CameraDisturbance(
    vignetting=0.6, blur=1.0, exposure=0.25, white_balance=0.1, noise=0.03
)


def capture(
    kind: str = KIND, seed: int = SEED, side: int = 2 * SIDE, forward: float = 0.0
) -> tuple[CameraRig, dict[str, Tensor]]:
    """The rig with its masks, as it is calibrated, and photographs ``(3, side, side)`` some metres further on."""
    rig = make_corner_rig(0.44, 0.6, (side, side), 220, 15)
    driven = (
        transform_from_axis_angle(torch.zeros(3), torch.tensor([0.0, 0.0, forward]))
        @ rig.world_from_camera
    )
    there = CameraRig(rig.cameras, driven)
    scene, body = with_carrier(make_scene(kind, seed), "vehicle", there)
    photographs = render_rig(scene, there, samples_per_pixel=4)
    taken = DISTURBANCE(
        {"images": photographs, "rig": rig}, torch.Generator().manual_seed(1)
    )["images"]
    return CameraRig(
        rig.cameras, rig.world_from_camera, carrier_masks(body, there)
    ), taken


def cloud(points: Tensor, colors: Tensor) -> np.ndarray:
    """Points ``(*, 3)`` seen from above and behind, without the ceiling, ``(400, 800, 3)`` of uint8."""
    camera = PinholeCamera.from_field_of_view(
        (SIDE, 2 * SIDE), math.radians(VIEW_DEG)
    )
    pose = transform_from_axis_angle(
        torch.tensor([0.0, math.radians(TURN_DEG), 0.0]), torch.zeros(3)
    )
    pose = pose @ transform_from_axis_angle(
        torch.tensor([-math.radians(TILT_DEG), 0.0, 0.0]), torch.zeros(3)
    )
    pose[:3, 3] = -DISTANCE * pose[:3, 2]
    points, colors = points.reshape(-1, 3), colors.reshape(-1, 3)
    kept = points[:, 1] > CEILING
    points = transform_points(invert_transform(pose), points[kept])
    pixels, valid = camera.project(points)
    far_first = points[valid, 2].argsort(descending=True)
    column, row = (pixels[valid][far_first] + 0.5).long().unbind(-1)
    drawn = colors[kept][valid][far_first].numpy()
    image = np.full((SIDE, 2 * SIDE, 3), 24, np.uint8)
    for down in (0, 1):
        for right in (0, 1):
            image[
                (row + down).clamp(max=SIDE - 1),
                (column + right).clamp(max=2 * SIDE - 1),
            ] = drawn
    return image


def steady(depth: Tensor) -> Tensor:
    """Where depth is nearly that of its neighbours. At edges, points hang in the air between near and far."""
    inverse = depth.reciprocal()[None]
    most = torch.nn.functional.max_pool2d(inverse, 5, 1, 2)
    least = -torch.nn.functional.max_pool2d(-inverse, 5, 1, 2)
    return ((most - least) < JUMP * inverse)[0]


def side_by_side(photographs: dict[str, Tensor], side: int) -> np.ndarray:
    """Photographs in a row, ``(side, 4 * side, 3)`` of uint8."""
    taken = (
        (255 * torch.cat(list(photographs.values()), -1).movedim(0, -1))
        .round()
        .byte()
        .numpy()
    )
    return cv2.resize(taken, (4 * side, side), interpolation=cv2.INTER_AREA)


def film() -> None:
    """Write what the vehicle sees on its way, and below it the depth of each frame, all in the colours of the first."""
    pictures, predictor, nearest = [], None, 0.0
    for frame in range(FRAMES):
        rig, photographs = capture(
            FILM_KIND, FILM_SEED, SIDE, METRES * frame / FRAMES
        )
        predictor = predictor or Predictor(rig)
        depth = predictor(photographs)
        around = depth.panorama(SIDE)
        nearest = nearest or near_end(around.depth, depth.min_depth)
        strength = confidence_strength(around.confidence, around.seen)
        colors = depth_panorama(around.depth, nearest, strength=strength)
        pictures.append(
            Image.fromarray(
                np.concatenate((side_by_side(photographs, SIDE // 2), colors), 0)
            )
        )
        print(f"frame {frame + 1} of {FRAMES}", flush=True)
    there_and_back = pictures + pictures[-2:0:-1]
    there_and_back[0].save(
        FILM,
        save_all=True,
        append_images=there_and_back[1:],
        duration=MILLISECONDS,
        loop=0,
        quality=55,
        method=6,
    )


def main() -> None:
    """Write the picture."""
    rig, photographs = capture()
    depth = Predictor(rig)(photographs)
    around = depth.panorama(SIDE)
    colors = depth_to_color(around.depth, near_end(around.depth, depth.min_depth))
    colors = fade(colors, confidence_strength(around.confidence, around.seen))
    taken = side_by_side(photographs, SIDE)
    dense = depth.panorama(4 * SIDE)
    image, _ = rgb_panorama(rig, photographs, 4 * SIDE, dense.depth)
    points = Equirectangular(4 * SIDE, 8 * SIDE).directions * dense.depth[..., None]
    kept = dense.seen & (dense.confidence > 0.6) & steady(dense.depth)
    shown = cloud(
        points[kept], (255 * image.movedim(0, -1).clamp(0, 1))[kept].byte()
    )
    rows = [taken, np.concatenate([colors, shown], 1)]
    picture = np.concatenate(rows, 0)
    cv2.imwrite(str(OUTPUT), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    film() if sys.argv[1:] == ["film"] else main()
