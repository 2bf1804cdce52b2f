# SPDX-License-Identifier: Apache-2.0
"""A vehicle's drive: rendered photographs with the faults of real ones, and below them the depth of each frame.

``python docs/drive.py`` writes docs/images/drive.webp; it takes two minutes. Four fisheyes stand at the corners of the
vehicle, which is in view and masked. Each loses light towards its edge, is a little out of focus, and has its own
exposure, white balance and noise. The scene is none of those that the network was trained on, and each frame is
estimated by itself.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from sphericalvision import Predictor
from sphericalvision.cameras import CameraRig
from sphericalvision.geometry import (
    transform_from_axis_angle,
)
from sphericalvision.recipes.app.rigs import make_corner_rig
from sphericalvision.scenes import make_scene, render_rig
from sphericalvision.scenes.carriers import carrier_masks, with_carrier
from sphericalvision.scenes.disturbances import CameraDisturbance
from sphericalvision.viz import depth_panorama
from sphericalvision.viz.color import near_end
from sphericalvision.viz.panorama import confidence_strength

OUTPUT = Path(__file__).parent / "images" / "drive.webp"
KIND, SEED = "outdoors", 10_100_012
SIDE = 400
"""Pixels of a fisheye image, and rows of the panorama of depth."""
FRAMES, METRES, MILLISECONDS = 16, 0.9, 200
"""How many, how far the vehicle drives in them, and how long each is shown."""
DISTURBANCE = CameraDisturbance(
    vignetting=0.6, blur=1.0, exposure=0.25, white_balance=0.1, noise=0.03
)


def capture(forward: float) -> tuple[CameraRig, dict[str, Tensor]]:
    """The rig with its masks, as it is calibrated, and photographs ``(3, SIDE, SIDE)`` some metres further on."""
    rig = make_corner_rig(0.44, 0.6, (SIDE, SIDE), 220, 15)
    driven = (
        transform_from_axis_angle(torch.zeros(3), torch.tensor([0.0, 0.0, forward]))
        @ rig.world_from_camera
    )
    there = CameraRig(rig.cameras, driven)
    scene, body = with_carrier(make_scene(KIND, SEED), "vehicle", there)
    photographs = render_rig(scene, there, samples_per_pixel=4)
    taken = DISTURBANCE(
        {"images": photographs, "rig": rig}, torch.Generator().manual_seed(1)
    )["images"]
    return CameraRig(
        rig.cameras, rig.world_from_camera, carrier_masks(body, there)
    ), taken


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
        rig, photographs = capture(METRES * frame / FRAMES)
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
    # for who asks for pages that do not move
    pictures[FRAMES // 2].save(OUTPUT.with_name("drive-still.webp"), quality=80)
    there_and_back = pictures + pictures[-2:0:-1]
    there_and_back[0].save(
        OUTPUT,
        save_all=True,
        append_images=there_and_back[1:],
        duration=MILLISECONDS,
        loop=0,
        quality=55,
        method=6,
    )


if __name__ == "__main__":
    film()
