# SPDX-License-Identifier: Apache-2.0
"""Prediction on images of one camera that moves: windows of them are the rigs that their poses say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module

from sphericalvision.cameras import EquirectangularCamera, read_trajectory
from sphericalvision.capture import Predictor
from sphericalvision.capture.sources.frames import Selection
from sphericalvision.core import ArgumentError
from sphericalvision.io.images import read_image, write_image
from sphericalvision.recipes.app.captures import open_moving
from tests.recipes.tiny import Run

SIZE = (24, 48)
NUMBER = 7


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Seven panoramas on a straight way, the fourth of which was taken where the third was, in a world with z up."""
    generator = torch.Generator().manual_seed(1)
    lines = []
    for number, place in enumerate((0.0, 0.1, 0.2, 0.2, 0.3, 0.4, 0.5)):
        lines.append(f"{number} 0 {place} 0 -0.70710678 0 0 0.70710678")
        write_image(tmp_path / f"walk/{number:03d}.png", torch.rand(3, *SIZE, generator=generator))
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    return tmp_path


def keys(capture: Path, **given: Any) -> dict[str, Any]:
    """Those of ``predict`` that say where the images and their poses are."""
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        words = [
            f"images={capture / 'walk'}",
            f"poses={capture / 'poses.txt'}",
            "calibration=equirectangular",
        ]
        return {**compose("predict", words), **given}


def words(capture: Path) -> list[str]:
    return [
        "calibration=equirectangular",
        f"images={capture / 'walk'}",
        f"poses={capture / 'poses.txt'}",
        "up=z",
        "spacing=0.1",
        "method=semi_global",
        "level=3",
        "num_hypotheses=8",
        "min_depth=0.5",
        "output=out",
        "outputs=[npz]",
        "height=16",
        "device=cpu",
    ]


def test_windows_are_the_rigs_that_poses_say(run: Run, capture: Path, tmp_path: Path) -> None:
    run("predict", *words(capture))
    written = sorted(path.name for path in (tmp_path / "out").glob("*.npz"))
    assert written == [f"{number:03d}_depth.npz" for number in (1, 2, 4, 5)]  # the fourth stood still
    trajectory = read_trajectory(capture / "poses.txt").turned("z")
    rig = trajectory.rig(EquirectangularCamera(SIZE), [2, 4, 5])
    images = {str(number): read_image(capture / f"walk/{number:03d}.png") for number in (2, 4, 5)}
    predictor = Predictor(rig, method="semi_global", level=3, num_hypotheses=8, min_depth=0.5)
    with np.load(tmp_path / "out/004_depth.npz") as arrays:
        np.testing.assert_allclose(arrays["center"], rig.center, atol=1e-6)
        np.testing.assert_allclose(arrays["index"], predictor(images).index, atol=1e-4)


def test_an_image_that_cannot_be_read_takes_its_windows_along(
    run: Run, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (capture / "walk/005.png").write_bytes(b"no image")
    with pytest.raises(SystemExit):
        run("predict", *words(capture))
    assert "2 of 4 frames were left out" in capsys.readouterr().err.replace("\n", " ")
    assert len(list((tmp_path / "out").glob("*.npz"))) == 2


def test_windows_of_a_video_and_of_few_images(capture: Path) -> None:
    writer = cv2.VideoWriter(str(capture / "walk.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 1.0, SIZE[::-1])
    for number in range(NUMBER):
        writer.write(np.full((*SIZE, 3), 30 * number, np.uint8))
    writer.release()
    moving = open_moving(keys(capture, images=f"{capture}/walk.avi", spacing=0.1, up="z"))
    assert moving.rig.cameras["000002"].image_size == SIZE
    frames = list(moving.frames(Selection(1, None, 2), lambda _: True))
    assert [frame.name for frame in frames] == ["000002", "000005"]
    assert frames[1].images is not None
    greys = [float(np.asarray(image).mean()) for image in frames[1].images.values()]
    np.testing.assert_allclose(greys, [120, 150, 180], atol=3)
    assert frames[1].rig is not None
    assert frames[1].rig.names == ["000004", "000005", "000006"]
    still = open_moving(keys(capture, window=2))
    (frame,) = still.frames(Selection(2, 3), lambda _: True)
    assert frame.images is None
    assert "in one place" in str(frame.error)


def test_too_few_images_and_unknown_poses_are_told(
    run: Run, capture: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ArgumentError, match=r"spacing: expected 3 poses 0\.4 m apart"):
        open_moving(keys(capture, spacing=0.4))
    with pytest.raises(SystemExit):
        run("predict", *words(capture), "cameras=[cam1]")
    assert "with poses there is one camera" in capsys.readouterr().err
