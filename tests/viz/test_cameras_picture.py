# SPDX-License-Identifier: Apache-2.0
"""Pictures of cameras and rigs show what they say: colours stand where the numbers are."""

import math

import numpy as np
import pytest
import torch

from sphericalvision.cameras import CameraRig, FisheyeCamera, PinholeCamera, ring_rig
from sphericalvision.viz import angle_map, coverage_panorama, rig_picture


def colored(picture: np.ndarray, color: tuple[int, int, int], tolerance: int = 12) -> np.ndarray:
    return (np.abs(picture.astype(int) - color) <= tolerance).all(-1)


def test_the_edge_of_validity_is_a_red_circle_around_the_axis() -> None:
    """Of an equidistant lens; the scale of the drawing follows from the cross on the axis."""
    lens = FisheyeCamera("equidistant", 100.0, [199.5, 149.5], (300, 400), math.radians(70))
    picture = angle_map(lens)
    rows, columns = colored(picture, (255, 0, 0), 60).nonzero()
    assert len(rows) > 200
    height, width = rows.max() - rows.min(), columns.max() - columns.min()
    assert height == pytest.approx(width, abs=3), "a circle in an image of square pixels"


def test_a_lens_that_fills_its_image_has_no_edge() -> None:
    camera = PinholeCamera([200.0, 200.0], [99.5, 99.5], (200, 200))
    assert colored(angle_map(camera), (255, 0, 0), 60).sum() < 120  # the cross alone


def test_the_image_is_drawn_below_the_contours_and_the_mask_shades_it() -> None:
    camera = PinholeCamera([200.0, 200.0], [99.5, 99.5], (200, 200))
    green = torch.zeros(3, 200, 200)
    green[1] = 1
    plain = colored(angle_map(camera, green), (0, 255, 0)).sum()
    mask = torch.ones(200, 200, dtype=torch.bool)
    mask[:100] = False
    masked = angle_map(camera, green, mask)
    assert colored(masked, (0, 255, 0)).sum() == pytest.approx(plain / 2, rel=0.1)
    assert colored(masked, (0, 102, 0)).sum() == pytest.approx(plain / 2, rel=0.1)


def test_coverage_colours_the_shares_of_its_legend() -> None:
    """One camera of 180° looks at the front half: the middle half of the columns, all rows."""
    lens = FisheyeCamera.from_field_of_view((400, 400), math.pi)
    rig = CameraRig([lens], torch.eye(4)[None])
    picture = coverage_panorama(rig)
    grey = colored(picture, (191, 191, 191), 2)
    color = picture[picture.shape[0] // 2, picture.shape[1] // 2 + 40]
    seen = colored(picture, tuple(int(channel) for channel in color), 2)
    assert grey.sum() == pytest.approx(seen.sum(), rel=0.03)
    assert seen.nonzero()[1].mean() == pytest.approx(grey.nonzero()[1].mean(), abs=8)


def test_every_camera_of_a_rig_is_drawn_in_its_colour() -> None:
    picture = rig_picture(ring_rig(3))
    for color in ((31, 119, 180), (255, 127, 14), (44, 160, 44)):  # matplotlib's tab10
        both = colored(picture, color)
        half = picture.shape[0] // 2
        assert both[:half].sum() > 50
        assert both[half:].sum() > 50


def test_what_is_higher_in_the_world_is_higher_in_the_picture() -> None:
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[:, 1, 3] = torch.tensor([-0.2, 0.2])
    picture = rig_picture(CameraRig([PinholeCamera([200.0, 200.0], [99.5, 99.5], (200, 200))] * 2, poses))
    space = picture[: picture.shape[0] // 2]
    upper, lower = (colored(space, color).nonzero()[0].mean() for color in ((31, 119, 180), (255, 127, 14)))
    assert upper < lower - 20
