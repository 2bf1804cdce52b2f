# SPDX-License-Identifier: Apache-2.0
"""What one's own rig gains: a rendered capture of a faulty rig to adapt to, and the error on other scenes with truth.

``python docs/adapted_rig.py write FOLDER`` writes 50 frames and the calibration; ``python docs/adapted_rig.py measure
FOLDER WEIGHTS`` compares what can be done, with ``FOLDER/aligned.yaml`` of ``sphericalvision-align``, the vehicle found
in the frames, and adapted weights. The rig is that of ``rig=ugv``, the vehicle in view; its pictures are grey and lose
up to 60 % of the light at the edge, and all four cameras are calibrated 0.3 degrees off.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig, read_rig, save_rig, seen_by
from sphericalvision.capture import Predictor, find_own_body
from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.icosphere import Icosphere
from sphericalvision.io.images import read_image, write_image
from sphericalvision.models import load_weights, pretrained
from sphericalvision.recipes.app.rigs import make_corner_rig
from sphericalvision.scenes import make_scene, ray_depth, render_rig
from sphericalvision.scenes.carriers import carrier_masks, with_carrier
from sphericalvision.scenes.disturbances import CameraDisturbance, turned_poses
from sphericalvision.scenes.registry import TURNS, kind_of
from sphericalvision.scenes.world import CLEAR_RADIUS, HELD_OUT_SEED
from sphericalvision.sweep import index_from_inverse_depth

RIG = make_corner_rig(image_size=(256, 256))
OFF = turned_poses(RIG, math.radians(0.3), torch.Generator().manual_seed(3))
FAULTS = CameraDisturbance(grey=True, vignetting=0.6)
CAPTURE, TESTED = range(100, 150), range(20)
HYPOTHESES, NEAREST = 16, 0.55
VEHICLE = 0  # seed of its materials: the same in all frames


def frame(
    number: int, faults: CameraDisturbance
) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Images, true index at level 6, and where two cameras see past the vehicle."""
    seed = HELD_OUT_SEED + number
    scene = make_scene(
        kind_of(TURNS, seed), seed, center=RIG.center, clear_radius=CLEAR_RADIUS
    )
    carried = with_carrier(scene, "vehicle", RIG, VEHICLE)
    images = {
        name: (255 * image).round() / 255
        for name, image in render_rig(carried.scene, RIG, 1).items()
    }
    same_cameras = torch.Generator().manual_seed(7)
    images = faults({"images": images, "rig": RIG}, same_cameras)["images"]
    vertices = Icosphere(6).vertices
    inverse_depth = ray_depth(scene, RIG.center, vertices).reciprocal()
    valid = inverse_depth <= 1 / NEAREST
    free = CameraRig(
        RIG.cameras, RIG.world_from_camera, carrier_masks(carried.body, RIG)
    )
    counts = valid & (seen_by(free, vertices, inverse_depth.where(valid, 0.0)) >= 2)
    return (
        images,
        index_from_inverse_depth(inverse_depth, HYPOTHESES, NEAREST),
        counts,
    )


def write(folder: Path) -> None:
    """Write the capture and its calibration."""
    for position, number in enumerate(CAPTURE):
        for name, image in frame(number, FAULTS)[0].items():
            (folder / name).mkdir(parents=True, exist_ok=True)
            write_image(folder / name / f"{position:05d}.png", image)
    save_rig(OFF, folder / "rig.yaml")


def capture(folder: Path) -> Iterator[dict[str, Tensor]]:
    """The frames that were written."""
    for position in range(len(CAPTURE)):
        yield {
            name: read_image(folder / name / f"{position:05d}.png")
            for name in RIG.names
        }


def measure(folder: Path, weights: str) -> None:
    """Print MAE in percent of N at level 6, mean over the tested scenes, of all that can be done, step by step."""
    shipped, adapted = pretrained("refinedsweepnet"), load_weights(weights)
    aligned = read_rig(folder / "aligned.yaml")
    masks = find_own_body(aligned, capture(folder)).masks
    masked, clean = (
        CameraRig(rig.cameras, rig.world_from_camera, masks)
        for rig in (aligned, RIG)
    )
    kinds: dict[str, tuple[CameraDisturbance, dict[str, Predictor]]] = {
        "disturbed": (
            FAULTS,
            {
                "photometric=false": Predictor(
                    OFF,
                    shipped,
                    min_depth=NEAREST,
                    preparation=Preparation(photometric=False),
                ),
                "as it is": Predictor(OFF, shipped, min_depth=NEAREST),
                "aligned": Predictor(aligned, shipped, min_depth=NEAREST),
                "aligned, masked": Predictor(masked, shipped, min_depth=NEAREST),
                "aligned, masked, adapted": Predictor(
                    masked, adapted, min_depth=NEAREST
                ),
            },
        ),
        "clean": (
            CameraDisturbance(),
            {
                "as it is": Predictor(RIG, shipped, min_depth=NEAREST),
                "masked": Predictor(clean, shipped, min_depth=NEAREST),
                "masked, adapted": Predictor(clean, adapted, min_depth=NEAREST),
            },
        ),
    }
    for title, (faults, ways) in kinds.items():
        errors = []
        for number in TESTED:
            images, truth, counts = frame(number, faults)
            said = [predictor(images).index for predictor in ways.values()]
            errors.append(
                [
                    ((index - truth).abs() * 100 / HYPOTHESES)[counts].mean()
                    for index in said
                ]
            )
        columns = torch.tensor(errors).T
        for name, column in zip(ways, columns, strict=True):
            better = int((column < columns[0]).sum())
            change = 100 * (column.mean() / columns[0].mean() - 1)
            print(
                f"{title}, {name}: {column.mean():.2f} ({change:+.1f} %), better in {better} of {len(TESTED)} scenes"
            )


if __name__ == "__main__":
    if sys.argv[1] == "write":
        write(Path(sys.argv[2]))
    else:
        measure(Path(sys.argv[2]), sys.argv[3])
