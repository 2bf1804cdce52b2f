# SPDX-License-Identifier: Apache-2.0
"""The six small pictures of the first page: ``python docs/cards.py`` writes docs/images/cards in a minute."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from sphericalvision import Predictor
from sphericalvision.cameras import FisheyeCamera, ring_rig, undistort
from sphericalvision.crown import to_crown
from sphericalvision.icosphere import Icosphere
from sphericalvision.scenes import (
    SURFACE_LABELS,
    make_scene,
    ray_labels,
    render_directions,
    render_rig,
)
from sphericalvision.sphere import Cubemap, Equirectangular, cube_to_layout
from sphericalvision.viz import coverage_panorama, depth_to_color

FOLDER = Path(__file__).parent / "images" / "cards"
HEIGHT, WIDTH = 180, 360
RIG = ring_rig(4, image_size=(360, 360))
SCENE = make_scene("room", seed=10_100_011)
PANORAMA = Equirectangular(HEIGHT, WIDTH)


def save(name: str, picture: np.ndarray) -> None:
    """Write an RGB picture (h, w, 3) in the middle of a card."""
    scale = min(HEIGHT / picture.shape[0], WIDTH / picture.shape[1])
    size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
    card = np.full((HEIGHT, WIDTH, 3), 24, np.uint8)
    top, left = (HEIGHT - size[1]) // 2, (WIDTH - size[0]) // 2
    card[top : top + size[1], left : left + size[0]] = cv2.resize(
        picture, size, interpolation=cv2.INTER_AREA
    )
    cv2.imwrite(
        str(FOLDER / f"{name}.webp"),
        card[..., ::-1],
        [cv2.IMWRITE_WEBP_QUALITY, 80],
    )


def pixels(image: Tensor) -> np.ndarray:
    """An image (3, h, w) in [0, 1] as a picture."""
    return (255 * image.clamp(0, 1).movedim(0, -1)).round().byte().numpy()


def main() -> None:
    """Write all six."""
    FOLDER.mkdir(exist_ok=True)
    images = render_rig(SCENE, RIG, samples_per_pixel=4)
    save(
        "depth",
        depth_to_color(
            Predictor(RIG, min_depth=0.55)(images).panorama(HEIGHT).depth, 0.7
        ),
    )
    save("coverage", coverage_panorama(RIG, depth=1.0, height=HEIGHT))
    name = RIG.names[0]
    lens = RIG.cameras[name]
    assert isinstance(lens, FisheyeCamera)
    flat = undistort(images[name], lens, math.radians(100), image_size=(360, 360))
    save("cameras", pixels(torch.cat([images[name], flat], -1)))
    center = RIG.center
    cube = Cubemap(90)
    faces = render_directions(
        SCENE, center, cube.directions.reshape(-1, 3)
    ).unflatten(-1, cube.shape)
    save("grids", pixels(cube_to_layout(faces, "dice")))
    ico = Icosphere(6)
    charts = to_crown(render_directions(SCENE, center, ico.directions)[None]).col[0]
    save("crown", pixels(torch.cat(list(charts), -1)))
    rays = PANORAMA.directions.reshape(-1, 3)
    labels = ray_labels(SCENE, center, rays)
    palette = (
        torch.rand(
            len(SURFACE_LABELS), 3, generator=torch.Generator().manual_seed(4)
        )
        * 0.8
        + 0.2
    )
    colors = palette[labels.clamp(min=0)].T.unflatten(-1, PANORAMA.shape)
    seen = render_directions(SCENE, center, rays).unflatten(-1, PANORAMA.shape)
    save(
        "scenes",
        pixels(torch.cat([seen[..., : WIDTH // 2], colors[..., WIDTH // 2 :]], -1)),
    )


if __name__ == "__main__":
    main()
