# SPDX-License-Identifier: Apache-2.0
"""A camera from pictures of a checkerboard: the work behind ``sphericalvision-calibrate``."""

from __future__ import annotations

import glob
import math
import re
from pathlib import Path

import cv2
import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from sphericalvision.cameras import field_of_view, save_camera
from sphericalvision.cameras.calibration import CAMERA_FORMATS
from sphericalvision.cameras.registry import camera_model_names
from sphericalvision.capture import calibrate_camera
from sphericalvision.capture.calibrating.refine import RefinedCamera
from sphericalvision.core import ArgumentError, MissingFileError, check_choice
from sphericalvision.io.images import read_image
from sphericalvision.recipes.app.cli import console, print_table

__all__ = ["board_corners", "calibrate", "find_corners"]


def calibrate(config: DictConfig) -> RefinedCamera:
    """Find the corners in ``config.images``, calibrate, print how well that went, and write ``config.output``.

    Raises:
        ArgumentError: the board is found on less than three pictures, or a key makes no sense; the message names it.
        MissingFileError: there are no such pictures.
    """
    check_choice("to", config.to, camera_model_names())
    if config.format is not None:
        check_choice("format", config.format, CAMERA_FORMATS)
    columns, rows = _board_size(str(config.board))
    paths = sorted(Path(path) for path in glob.glob(config.images, recursive=True))
    if not paths:
        raise MissingFileError(
            f"images: no file like {config.images!r}; a pattern such as board/*.png is expected"
        )
    found: dict[Path, Tensor] = {}
    size: tuple[int, int] | None = None
    for path in paths:
        image = read_image(path, size, "a picture of the board, of the size of the first one")
        size = (image.shape[-2], image.shape[-1])
        corners = find_corners(image, columns, rows)
        if corners is not None:
            found[path] = corners
    if size is None or len(found) < 3:
        raise ArgumentError(
            f"images: the board of {columns}x{rows} inner corners is found on {len(found)} of {len(paths)} pictures, "
            "and three are needed, better twenty; count the corners between squares, not the squares, and leave a "
            "white border around them"
        )
    points = board_corners(columns, rows, float(config.square))
    pixels = torch.stack(list(found.values()))
    options = {"num_coefficients": config.num_coefficients, "projection": config.projection}
    angle = math.radians(config.field_of_view_deg)
    result = calibrate_camera(points, pixels, size, config.to, field_of_view=angle, **options)
    _print(config, result, found, len(paths))
    save_camera(result.camera, config.output, config.format)
    print(config.output)
    return result


def board_corners(columns: int, rows: int, square: float) -> Tensor:
    """Inner corners (columns · rows, 3) of a board, row by row, in metres; z = 0.

    Examples:
        >>> board_corners(2, 2, 0.5).tolist()
        [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.5, 0.5, 0.0]]
    """
    v, u = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return torch.stack((u, v, torch.zeros_like(u)), -1).reshape(-1, 3).double() * square


def find_corners(image: Tensor, columns: int, rows: int) -> Tensor | None:
    """Pixels (columns · rows, 2) of a board's inner corners on an image (3, h, w) in [0, 1]; None without a board."""
    grey = (image.mean(0) * 255).round().to(torch.uint8).numpy()
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    seen, corners = cv2.findChessboardCorners(grey, (columns, rows), flags=flags)
    if not seen:
        return None
    corners = corners.reshape(rows, columns, 2)
    steps = np.concatenate([np.diff(corners, axis=axis).reshape(-1, 2) for axis in (0, 1)])
    window = int(np.clip(np.linalg.norm(steps, axis=-1).min() * 0.35, 1, 11))  # no corner sees its neighbour
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    flat = np.ascontiguousarray(corners.reshape(-1, 1, 2), np.float32)
    fine = cv2.cornerSubPix(grey, flat, (window, window), (-1, -1), criteria)
    return torch.from_numpy(fine.reshape(-1, 2)).double()


def _board_size(board: str) -> tuple[int, int]:
    match = re.fullmatch(r"\s*(\d+)\s*x\s*(\d+)\s*", board)
    if not match or min(int(match[1]), int(match[2])) < 3:
        raise ArgumentError(
            f"board: expected inner corners as COLUMNSxROWS, 3 or more, such as 9x6, got {board!r}"
        )
    return int(match[1]), int(match[2])


def _print(config: DictConfig, result: RefinedCamera, found: dict[Path, Tensor], pictures: int) -> None:
    rms = result.residuals.square().sum(-1).mean(-1).sqrt()
    rows = [[path.name, f"{value:.3f}"] for path, value in zip(found, rms.tolist(), strict=True)]
    print_table(f"boards on {len(found)} of {pictures} pictures", ["picture", "RMS (px)"], rows)
    camera = result.camera
    widest = math.degrees(field_of_view(camera).widest)
    console.print(f"{type(camera).__name__}: RMS {result.rms_error:.3f} px, sees {widest:.1f}°")
    for name in camera.intrinsic_names:
        values = getattr(camera, name)
        if values is not None:
            console.print(f"  {name}: {', '.join(f'{value:.6g}' for value in values.flatten().tolist())}")
    console.print(f"written as {config.format or 'native'}")
