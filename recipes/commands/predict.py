# SPDX-License-Identifier: Apache-2.0
"""Depth of one's own captures: picture, point cloud and arrays of each frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from omegaconf import DictConfig
from rich.progress import track
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.core import ArgumentError, FileFormatError, check_choice
from sphericalvision.deploy import Predictor
from sphericalvision.io.images import read_image
from sphericalvision.recipes.app.captures import Capture, find_capture, find_masks, read_frame
from sphericalvision.recipes.app.cli import choose_device, console, print_config
from sphericalvision.recipes.app.results import result_of, save_result
from sphericalvision.recipes.app.rigs import rig_from_file

__all__ = ["load_rig", "predict", "predictor_for"]


def load_rig(config: DictConfig) -> CameraRig:
    """Read the calibration, take the cameras asked for, and put the masks on."""
    rig = rig_from_file(config.calibration, config.translation_unit, config.max_angle_deg)
    if config.cameras is not None:
        rig = rig.subset(list(config.cameras))
    if config.masks is None:
        return rig
    masks: dict[str, Tensor] = {}
    for name, path in find_masks(config.masks, rig.names).items():
        masks[name] = read_image(path, rig.cameras[name].image_size, f"the mask of camera {name}")[0] > 0.5
    return CameraRig(rig.cameras, rig.world_from_camera, masks=masks)


def predictor_for(rig: CameraRig, config: DictConfig) -> Predictor:
    """The predictor that a configuration describes.

    Raises:
        ArgumentError: the network wants another number of cameras, or ``min_depth`` is no number and no known word.
    """
    if isinstance(config.min_depth, str) and config.min_depth not in ("auto", "scene"):
        raise ArgumentError(
            f"min_depth: expected a number of metres, auto or scene, got {config.min_depth!r}"
        )
    return Predictor(
        rig,
        config.checkpoint,
        method=config.method,
        min_depth=None if config.min_depth == "auto" else config.min_depth,
        level=config.level,
        num_hypotheses=config.num_hypotheses,
        device=choose_device(config.device),
        antialias=config.antialias,
        native=config.native,
        trained_radius=config.trained_radius,
    )


def find_nearest(predictor: Predictor, capture: Capture, rig: CameraRig) -> float:
    """The nearest hypothesis in metres that suits what is seen in up to three frames of a capture."""
    frames = list(capture.files.values())
    chosen = [frames[number] for number in sorted({0, len(frames) // 2, len(frames) - 1})]
    return predictor.find_min_depth(read_frame(files, rig) for files in chosen)


def predict(config: DictConfig, folder: Path) -> list[Path]:
    """Write picture, point cloud and arrays of each frame to ``folder``; returns the files.

    Raises:
        FileFormatError: images of some frames cannot be read; the others are done before that is told.
    """
    check_choice("on_error", config.on_error, ("skip", "stop"))
    rig = load_rig(config)
    masks = () if config.masks is None else find_masks(config.masks, rig.names).values()
    capture = find_capture(config.images, rig.names, config.frames, leave_out=masks)
    predictor = predictor_for(rig, config)
    if config.min_depth == "scene":
        config.min_depth = round(find_nearest(predictor, capture, rig), 3)
    print_config(config, folder)
    console.print(
        f"{len(capture.files)} frame(s), {len(rig)} cameras, rig radius {float(rig.radius):.3f} m, "
        f"nearest hypothesis {predictor.min_depth:.3f} m"
    )
    written, wrong, seen = [], [], []
    for frame, files in track(todo(capture, folder, config).items(), "estimating depth", console=console):
        try:
            images = read_frame(files, rig)
        except (FileFormatError, OSError) as error:
            if config.on_error == "stop":
                raise
            wrong.append(str(error))
            console.print(f"left out: {error}", style="yellow", highlight=False, soft_wrap=True)
            continue
        result = result_of(predictor(images), config.height)
        seen.append(result.share_matched)
        written += save_result(folder, prefix_of(frame), result, images, rig)
    for path in written:
        print(path)
    if seen and min(seen) < ENOUGH:
        print(
            f"Two cameras see {100 * min(seen):.0f} % of all directions at the depth estimated. Elsewhere nothing can "
            "be measured: grey in depth.png, left out of points.ply, False in matched_panorama of depth.npz."
        )
    if wrong:
        raise FileFormatError(
            f"{len(wrong)} of {len(capture.files)} frames were left out. The first: {wrong[0]}"
        )
    return written


ENOUGH = 0.98
"""Share of the sphere that two cameras see, below which it is said."""


def prefix_of(frame: str) -> str:
    """What the names of a frame's files begin with."""
    return f"{frame}_" if frame else ""


def todo(capture: Capture, folder: Path, config: DictConfig) -> dict[str, Mapping[str, Path]]:
    """The frames that are to be done: with ``skip_existing`` those whose last file is not there yet."""
    frames = dict(capture.files)
    if config.skip_existing:
        frames = {
            f: files for f, files in frames.items() if not (folder / f"{prefix_of(f)}depth.npz").is_file()
        }
        console.print(f"{len(capture.files) - len(frames)} frame(s) are in {folder} already", soft_wrap=True)
    return frames
