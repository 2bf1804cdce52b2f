# SPDX-License-Identifier: Apache-2.0
"""The page of pictures of a track: what there is to see, the truth, and each method with its errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from sphericalvision.recipes.study.comparison.frames import Frame
from sphericalvision.recipes.study.comparison.methods import SCALE
from sphericalvision.recipes.study.comparison.places import FrameTruth
from sphericalvision.sweep import depth_from_index
from sphericalvision.viz import depth_to_color, error_to_color, sheet
from sphericalvision.viz.panorama import icosphere_to_panorama

__all__ = ["WORST", "frame_pictures", "page"]

Picture = npt.NDArray[Any]

WORST = 10.0
"""Error in percent of N at the end of the scale of colours."""

FADED = 0.65
"""How far what fewer than two cameras see goes to grey."""


def page(frames: Mapping[str, tuple[Frame, Mapping[str, Tensor]]], rows: int) -> Picture:
    """All drawn frames of a track; see ``frame_pictures``.

    Args:
        frames: name -> the frame, and method's name -> its index ``(V,)`` at the fine vertices.
        rows: of each panorama.
    """
    columns = 2 + max(len(estimates) for _, estimates in frames.values())
    pictures = [
        sheet(frame_pictures(frame, estimates, rows), columns=columns) for frame, estimates in frames.values()
    ]
    return sheet(pictures)


def frame_pictures(frame: Frame, estimates: Mapping[str, Tensor], rows: int) -> dict[str, Picture]:
    """Titles and pictures of a frame: the view, the truth and depth by method; below a camera, edges, errors.

    Errors are from 0 (dark) to ``WORST`` percent of N (bright); what fewer than two cameras see is faded.
    """
    truth = FrameTruth(frame)
    counts = truth.regions["all"]
    faded = 1 - icosphere_to_panorama(counts.float(), rows)
    above = {
        f"view of {frame.name}": _colors(icosphere_to_panorama(frame.colors, rows)),
        "truth": _depth(truth.index.where(truth.valid, math.nan), rows),
    }
    below = {"first camera": _camera(frame, rows), "where it counts (red: edges)": _regions(truth, rows)}
    for name, index in estimates.items():
        error = (index - truth.index).abs() * (100 / SCALE.num_hypotheses)
        above[name] = _depth(index, rows)
        shown = error_to_color(icosphere_to_panorama(error.nan_to_num(WORST), rows), WORST)
        known = counts & ~error.isnan()
        mean = f"{float(error[known].mean()):.2f}" if known.any() else "-"
        below[f"error of {name}: MAE {mean}"] = _fade(shown, faded)
    return {**above, **below}


def _colors(image: Tensor) -> Picture:
    return (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()


def _depth(index: Tensor, rows: int) -> Picture:
    known = icosphere_to_panorama((~index.isnan()).float(), rows) > 0.5
    filled = icosphere_to_panorama(index.nan_to_num().clamp(min=0), rows)
    depth = depth_from_index(filled, *SCALE).where(known, math.nan)
    return depth_to_color(depth, SCALE.min_depth)


def _fade(picture: Picture, hidden: Tensor) -> Picture:
    share = (FADED * hidden.clamp(0, 1)).numpy()[..., None]
    return (picture * (1 - share) + 150.0 * share).round().astype(np.uint8)


def _camera(frame: Frame, rows: int) -> Picture:
    """The first camera's image as methods get it, in the middle of a panorama's size."""
    image = frame.images[frame.rig.names[0]]
    mask = frame.rig.masks.get(frame.rig.names[0])
    picture = _colors(image if mask is None else image * mask)
    width = min(2 * rows, round(rows * picture.shape[1] / picture.shape[0]))
    small = cv2.resize(picture, (width, rows), interpolation=cv2.INTER_AREA)
    left = (2 * rows - width) // 2
    canvas = np.full((rows, 2 * rows, 3), 255, np.uint8)
    canvas[:, left : left + width] = small
    return canvas


def _regions(truth: FrameTruth, rows: int) -> Picture:
    """White: seen by two cameras; red edges, blue thin things, yellow bare, light blue sky; grey does not count."""
    colors = torch.full((3, len(truth.index)), 0.55)
    for name, color in (
        ("all", (1.0, 1.0, 1.0)),
        ("bare", (0.85, 0.85, 0.6)),
        ("edge", (0.9, 0.2, 0.1)),
        ("thin", (0.1, 0.2, 0.9)),
        ("sky", (0.6, 0.8, 1.0)),
    ):
        colors[:, truth.regions[name]] = torch.tensor(color)[:, None]
    return _colors(icosphere_to_panorama(colors, rows))
