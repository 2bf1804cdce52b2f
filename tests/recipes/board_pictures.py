# SPDX-License-Identifier: Apache-2.0
"""Pictures of boards before fisheyes, rendered along exact rays from a drawing of the board."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from sphericalvision.cameras import Camera, CameraRig, FisheyeCamera, KannalaBrandtCamera
from sphericalvision.capture import AprilGrid, Charuco, Checkerboard
from sphericalvision.geometry import transform_from_axis_angle
from sphericalvision.io.images import write_image

COLUMNS, ROWS, SQUARE = 7, 5, 0.05
TRUTH = KannalaBrandtCamera(
    [118.0, 119.0], [160.3, 118.2], [-0.012, 0.003, 0.0, 0.0], (240, 320), math.radians(80)
)
CODES = (0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98, 0xEBCBCA822, 0xF31DAB3AC)
"""The first tags of 36h11 as Kalibr prints them: bits row by row from the top left, white is 1."""
CELL = 40
"""Pixels of a drawing in a square or, of an AprilGrid, in a bit."""
Image = npt.NDArray[np.uint8]
AnyBoard = AprilGrid | Charuco | Checkerboard


class Drawing:
    """A board as it is printed.

    Attributes:
        image: grey, with a white border.
        scale: (2,), pixels a metre along x and y of the board.
        start: (2,), the pixel of the board's origin.
        facing: (4, 4), turns a board so that its front looks back at the camera, as seen on the drawing.
    """

    def __init__(self, board: AnyBoard) -> None:
        if isinstance(board, AprilGrid):
            self.image, start, metres = _aprilgrid(board)
            down = -1.0
        else:
            squares = (board.columns + 1, board.rows + 1) if isinstance(board, Checkerboard) else None
            self.image = _checkerboard(*squares) if squares else _charuco(board)
            start, metres, down = (2.0 * CELL, 2.0 * CELL), board.square / CELL, 1.0
        self.scale, self.start = np.array([1, down]) / metres, np.array(start) - 0.5
        middle = torch.eye(4).double()
        middle[:3, 3] = -board.points.mean(0)
        self.facing = torch.diag(torch.tensor([1.0, down, down, 1.0])).double() @ middle


def _checkerboard(columns: int, rows: int) -> Image:
    cells = np.indices((rows, columns)).sum(0) % 2
    return np.pad(np.kron(cells, np.ones((CELL, CELL))) * 255, CELL, constant_values=255).astype(np.uint8)


def _charuco(board: Any) -> Image:
    columns, rows = board.board.getChessboardSize()
    drawn: Image = board.board.generateImage(((columns + 2) * CELL, (rows + 2) * CELL), marginSize=CELL)
    return drawn


def _aprilgrid(board: AprilGrid) -> tuple[Image, tuple[float, float], float]:
    """By Kalibr's rules: ids from the lower left, squares between corners, codes as it prints them."""
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    side, gap = 10 * CELL, round(10 * CELL * board.spacing)
    shape = [2 * 2 * gap + count * (side + gap) - gap for count in (board.rows, board.columns)]
    image = np.full(shape, 255, np.uint8)
    for tag in range(board.columns * board.rows):
        left = 2 * gap + tag % board.columns * (side + gap)
        top = shape[0] - 2 * gap - side - tag // board.columns * (side + gap)
        drawn = np.rot90(cv2.aruco.generateImageMarker(family, tag, side, borderBits=2), 2)
        if tag < len(CODES):
            bits = np.array([CODES[tag] >> (35 - bit) & 1 for bit in range(36)]).reshape(6, 6)
            drawn = 255 * np.kron(np.pad(bits, 2), np.ones((CELL, CELL)))
        image[top : top + side, left : left + side] = drawn
        for y in (top - gap, top + side):
            for x in (left - gap, left + side):
                image[y : y + gap, x : x + gap] = 0
    return image, (2.0 * gap, shape[0] - 2.0 * gap), board.tag / side


class Eye:
    """A camera with the rays of several samples in each pixel, which all its pictures share."""

    def __init__(self, camera: Camera, samples: int = 3) -> None:
        offsets = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
        steps = torch.cartesian_prod(offsets, offsets)
        self.rays = [camera.unproject(camera.pixel_grid(torch.float64) + step) for step in steps]

    def picture(self, drawing: Drawing, pose: Tensor, noise: float = 0.0, seed: int = 0) -> Image:
        """The board at ``camera_from_board`` before grey, (h, w, 3), with noise in grey values."""
        shade: Any = 0.0
        inverse = torch.linalg.inv(pose.double()).numpy()
        for rays, valid in self.rays:
            local = rays.double().numpy() @ inverse[:3, :3].T
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = -inverse[2, 3] / local[..., 2]
            there = (distance > 0) & (distance < 20)
            places = np.where(there, distance, 0)[..., None] * local + inverse[:3, 3]
            at = places[..., :2] * drawing.scale + drawing.start
            at = np.where(there[..., None], at, -1e3).clip(-1e4, 1e4).astype(np.float32)
            seen = cv2.remap(
                drawing.image,
                at[..., 0],
                at[..., 1],
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=110,
            )
            shade = shade + np.where(valid.numpy(), seen.astype(np.float32), 0)
        grey = 20 + shade / len(self.rays) * (215 / 255)
        grey += noise * np.random.default_rng(seed).standard_normal(grey.shape)
        return np.repeat(grey.clip(0, 255).round().astype(np.uint8)[..., None], 3, -1)


def boards(drawing: Drawing) -> Tensor:
    """Twelve poses of the board all over the picture, tilted."""
    step = torch.arange(12, dtype=torch.float64)
    angle, azimuth = math.radians(42) * ((step + 0.4) / 12).sqrt(), 2.4 * step
    towards = torch.stack((-azimuth.sin() * angle, azimuth.cos() * angle, 0 * step), -1)
    tilt = torch.stack((0.45 * (3 * step).sin(), 0.45 * (2 * step).cos(), 0.3 * step.sin()), -1)
    away = torch.tensor([[0.0, 0.0, 0.33]]).double().expand(12, 3)
    nothing = torch.zeros(12, 3).double()
    return (
        transform_from_axis_angle(towards, nothing) @ transform_from_axis_angle(tilt, away) @ drawing.facing
    )


def write_boards(folder: Path, aside: float = 0.0) -> None:
    """The pictures of all poses as ``00.png`` and so on, by a camera that stands some metres aside."""
    drawing, eye = Drawing(Checkerboard(COLUMNS, ROWS, SQUARE)), Eye(TRUTH)
    for index, pose in enumerate(boards(drawing)):
        pose[0, 3] -= aside
        write_image(folder / f"{index:02}.png", eye.picture(drawing, pose))


def back_to_back(number: int, side: int = 480) -> CameraRig:
    """Fisheyes of 200° that look outwards, none of them exactly, each a little different."""
    turn = torch.arange(number, dtype=torch.float64)
    yaw = turn * 2 * math.pi / number
    axes = torch.stack((0.012 * turn.sin(), yaw + 0.02 * turn.cos(), 0.015 * turn), -1)
    places = torch.stack((0.03 * yaw.sin(), 0.001 * turn, 0.03 * yaw.cos()), -1)
    cameras = [
        FisheyeCamera(
            "equisolid",
            torch.tensor([0.32 * side + 0.7 * k, 0.32 * side - 0.4 * k], dtype=torch.float64),
            [side / 2 + 1.3 * k - 1, side / 2 - 0.8 * k],
            (side, side),
            math.radians(100),
        )
        for k in range(number)
    ]
    names = [f"cam{place}" for place in range(number)]
    return CameraRig(dict(zip(names, cameras, strict=True)), transform_from_axis_angle(axes, places))


def around(number: int, drawing: Drawing, near: float = 0.4, far: float = 0.6) -> Tensor:
    """World from board of so many boards, (n, 4, 4): half of them in all directions, half square to the first axis."""
    step = torch.arange(number, dtype=torch.float64)
    nothing = torch.zeros(number, 3).double()
    height = (1.9 * (step + 0.5) / number - 0.95).asin()
    where = torch.where(step % 2 == 0, 2.39996 * step, math.pi / 2 * (1 - step % 4 // 2 * 2))
    yaw = transform_from_axis_angle(torch.stack((0 * step, where, 0 * step), -1), nothing)
    pitch = transform_from_axis_angle(torch.stack((height, 0 * step, 0 * step), -1), nothing)
    tilt = 0.5 * torch.stack(((3.1 * step).sin(), (2.3 * step).cos(), 4 * (1.7 * step).sin()), -1)
    away = torch.stack((0 * step, 0 * step, near + (far - near) * (0.618 * step).frac()), -1)
    return yaw @ pitch @ transform_from_axis_angle(tilt, away) @ drawing.facing
