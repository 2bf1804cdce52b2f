# SPDX-License-Identifier: Apache-2.0
"""Depth of one's own captures: image files, videos or live cameras in; pictures, points, arrays and a video out."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sphericalvision.cameras import CameraRig
from sphericalvision.capture import Depth, PhotometricCalibration, Predictor
from sphericalvision.capture.outputs import Outputs, Settings, done_file
from sphericalvision.capture.preparation.preparation import AUTO, Preparation
from sphericalvision.capture.sources.captures import find_masks
from sphericalvision.capture.sources.frames import Frame, Selection, Source
from sphericalvision.capture.sources.threads import Behind, ahead, side_by_side, threads_kept
from sphericalvision.core import ArgumentError, FileFormatError, check_choice
from sphericalvision.recipes.app.cli import choose_device, console, print_config
from sphericalvision.recipes.prediction.aligned import aligned
from sphericalvision.recipes.prediction.moving import open_moving
from sphericalvision.recipes.prediction.own_body import masked_by_itself
from sphericalvision.recipes.prediction.sources import open_source, read_capture_rig, rig_for_images

__all__ = ["load_rig", "nearest_in", "open_capture", "predict", "predictor_for"]


def load_rig(config: DictConfig) -> CameraRig:
    """Read the calibration, take the cameras asked for, and put the masks on."""
    masks = None if config.masks == AUTO else config.masks
    keys = (config.cameras, masks, config.translation_unit, config.max_angle_deg)
    return read_capture_rig(config.calibration, *keys)[0]


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
        min_depth=config.min_depth,
        level=config.level,
        num_hypotheses=config.num_hypotheses,
        device=choose_device(config.device),
        antialias=config.antialias,
        preparation=Preparation.from_keys(config),
        trained_radius=config.trained_radius,
    )


def open_capture(config: DictConfig) -> Source:
    """The frames that a configuration names, with the rig of each in the size of its images."""
    if config.poses is not None:
        refused = [key for key in ("cameras", "translation_unit") if config[key] is not None]
        if refused:
            raise ArgumentError(
                f"{refused[0]}: with poses there is one camera, in metres; leave {refused[0]} out"
            )
        if config.masks == AUTO:
            raise ArgumentError("masks: auto is for rigs; with poses give an image, white where usable")
        moving = open_moving(
            config.calibration,
            config.images,
            config.poses,
            window=config.window,
            spacing=config.spacing,
            up=config.up,
            mask=config.masks,
            frames=config.frames,
            max_angle_deg=config.max_angle_deg,
        )
        if moving.unposed:
            print(
                f"Warning: {moving.unposed} image(s) have no pose within 20 ms, or of their name; left out."
            )
        return moving
    rig = load_rig(config)
    masks = () if config.masks in (None, AUTO) else find_masks(config.masks, rig.names).values()
    source = open_source(config.images, rig, config.frames, masks)
    sizes = source.sizes()
    source.rig = rig_for_images(rig, sizes)
    if source.rig is not rig:
        print(_other_size(rig, sizes))
    return source


def nearest_in(samples: list[Frame], predictor: Predictor) -> float:
    """The nearest depth in metres of a few frames, of one rig or each of its own."""
    shared = [frame.images for frame in samples if frame.images is not None and frame.rig is None]
    if shared:
        return predictor.find_min_depth(shared)
    return min(
        predictor.with_rig(frame.rig).find_min_depth([frame.images])
        for frame in samples
        if frame.images is not None and frame.rig is not None
    )


def predict(config: DictConfig, folder: Path) -> list[Path]:
    """Write what ``config.outputs`` names of each frame to ``folder``; returns the files.

    Raises:
        FileFormatError: images of some frames cannot be read; the others are done before that is told.
    """
    check_choice("on_error", config.on_error, ("skip", "stop"))
    source = open_capture(config)
    if Preparation.from_keys(config).own_body:
        source.rig = masked_by_itself(source, folder)
    predictor = predictor_for(source.rig, config)
    before = _settings_before(folder) if config.skip_existing else {}
    if predictor.min_depth is None and "min_depth" in before:
        config.min_depth = before["min_depth"]
        predictor = predictor_for(source.rig, config)
    if predictor.min_depth is None and (samples := source.samples()):
        config.min_depth = round(nearest_in(samples, predictor), 3)
        if predictor.min_depth is None:  # windows have rigs of their own, and share the depth
            predictor = predictor_for(source.rig, config)
    _check_settings(config, before, folder)
    if config.poses is None:
        predictor = aligned(source, predictor, folder, bool(before))
    print_config(config, folder)
    selection = Selection(config.start, config.stop, config.every)
    names = source.names(selection)
    near = "found in the first frame" if predictor.min_depth is None else f"{predictor.min_depth:.3f} m"
    many = "live" if names is None else f"{len(names)} frame(s)"
    cameras = "cameras" if config.poses is None else "images in a window"
    console.print(
        f"{many}, {len(source.rig)} {cameras}, rig radius {float(source.rig.radius):.3f} m, nearest hypothesis {near}"
    )
    kinds = config.outputs or (("depth", "cloud", "npz") if source.rate == 0 else ("video",))
    rate = (source.rate or 10.0) / config.every
    settings = Settings(
        list(kinds),
        config.height,
        config.min_confidence,
        config.voxel,
        rate,
        config.near,
        config.skip_existing,
    )
    outputs = Outputs(folder, settings)
    left = _left_to_do(names, folder, config, outputs.settings)
    wrong = run(source, selection, predictor, outputs, left, config.on_error == "stop")
    for path in outputs.written[:MOST_PATHS]:
        print(path)
    if len(outputs.written) > MOST_PATHS:
        print(f"... {len(outputs.written)} files in {folder}")
    if shares := outputs.consistency.values():
        mean = sum(shares) / len(shares)
        print(
            f"photo-consistency: {mean:.3f} of what winner-takes-all reaches, mean of {len(shares)} frame(s)"
        )
    for warning in outputs.warnings:
        print(f"Warning: {warning}")
    if outputs.shares and min(outputs.shares) < ENOUGH:
        print(
            f"Two cameras see {100 * min(outputs.shares):.0f} % of all directions at the depth estimated. Elsewhere "
            "nothing can be measured: grey in pictures, left out of point clouds, False in matched_panorama of arrays."
        )
    if wrong:
        number = "some" if names is None else f"{len(wrong)} of {len(names)}"
        raise FileFormatError(f"{number} frames were left out. The first: {wrong[0]}")
    return outputs.written


MOST_PATHS = 30
"""Of files that are named at the end."""
ENOUGH = 0.9
"""Share of the sphere that two cameras see, below which it is said."""


class Done(NamedTuple):
    """A frame on its way to the files."""

    frame: Frame
    depth: Depth | None
    seconds: float = 0.0


FREE = (
    *("frames", "start", "stop", "every", "outputs", "output", "preset"),
    *("skip_existing", "on_error", "device"),
)
"""Settings that may change between a prediction and its continuation."""
MOST_WORKERS = 4
"""Frames that are estimated at once, each in memory of its own."""


def run(
    source: Source,
    selection: Selection,
    predictor: Predictor,
    outputs: Outputs,
    left: set[str] | None,
    stop_on_error: bool = False,
) -> list[str]:
    """Estimate frame after frame, while threads read the next ones and write the ones before; returns what was wrong.

    On a CPU as many frames as torch has threads, up to four, are estimated side by side.

    Args:
        source: of the frames.
        selection: which of them.
        predictor: of their depth.
        outputs: where depth goes.
        left: names of the frames to be done; None for all of them.
        stop_on_error: whether to raise the error of a frame that cannot be read.
    """
    columns = (
        TextColumn("estimating depth"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeRemainingColumn(),
    )
    wrong: list[str] = []
    number, busy = 0, 0.0

    # Colours follow the first frame of all: whoever goes on looks at that one once more, and only then at what is left.
    looks = bool(left) and outputs.follows_first_frame

    def there(name: str) -> bool:
        return left is not None and name not in left

    def wanted(name: str) -> bool:
        return not there(name) or (looks and outputs.near is None)

    def estimate(frame: Frame) -> Done:
        if frame.images is None or not wanted(frame.name):
            return Done(frame, None)
        start = time.perf_counter()
        mine = predictor if frame.rig is None else predictor.with_rig(frame.rig)
        depth = mine(frame.images)
        took = time.perf_counter() - start
        if not told.is_set():
            told.set()
            tell_noise(mine.noise(frame.images))
            tell_light(mine.light(frame.images))
        return Done(frame, depth, took)

    told = Event()  # of the first frame alone
    frames = ahead(source.frames(selection, wanted), newest=source.live)
    began = time.perf_counter()
    with threads_kept() as threads:
        workers = 1 if predictor.device.type != "cpu" else min(threads, MOST_WORKERS, *_number(left))
        estimated = side_by_side(estimate, frames, workers, threads // workers)
        try:
            with (
                Progress(*columns, console=console, refresh_per_second=4) as progress,
                Behind[Done](lambda done: outputs.write(done.frame.name, done.depth)) as behind,  # type: ignore[arg-type]
            ):
                task = progress.add_task("", total=None if left is None else len(left), speed="")
                for done in estimated:
                    if done.depth is not None:
                        outputs.begin(done.depth)
                    if there(done.frame.name):
                        continue
                    if done.depth is None:
                        error = done.frame.error
                        if stop_on_error and error is not None:
                            raise error
                        wrong.append(str(error))
                        console.print(f"left out: {error}", style="yellow", highlight=False, soft_wrap=True)
                    else:
                        busy += done.seconds / workers
                        behind.put(done)
                        number += 1
                    progress.update(
                        task, advance=1, speed=f"{number / (time.perf_counter() - began):.2f} frames/s"
                    )
        except KeyboardInterrupt:
            if not source.live:  # live cameras have no other end
                raise
        finally:
            estimated.close()  # type: ignore[attr-defined]
            frames.close()  # type: ignore[attr-defined]
            outputs.close()
    took = time.perf_counter() - began
    if number:
        console.print(
            f"{number} frame(s) in {took:.1f} s: {number / took:.2f} frames/s, the network busy "
            f"{100 * busy / took:.0f} % of the time",
            highlight=False,
        )
    return wrong


def tell_noise(noise: Mapping[str, float]) -> None:
    """Print how strong the noise is that is smoothed in the first frame; nothing if none is."""
    if not any(noise.values()):
        return
    told = ", ".join(f"{100 * amount:.1f} % of {name}" for name, amount in noise.items() if amount)
    console.print(
        f"photometric=true smooths noise: {told} (in the first frame)", highlight=False, soft_wrap=True
    )


def tell_light(light: PhotometricCalibration | None) -> None:
    """Print what is compensated in the first frame; nothing if nothing is."""
    if light is None:
        return
    exposure, falloff = light.exposure.mean(1).exp(), 1 - (-light.falloff.sum(1)).exp()
    console.print(
        f"photometric=true compensates exposures of {exposure.min():.2f} to {exposure.max():.2f} of the mean and "
        f"lenses that lose up to {100 * falloff.max():.0f} % of the light at the edge (in the first frame)",
        highlight=False,
        soft_wrap=True,
    )


def _number(left: set[str] | None) -> list[int]:
    """How many frames there are, where that is known; at least one."""
    return [] if left is None else [max(1, len(left))]


def _settings_before(folder: Path) -> dict[str, Any]:
    """Settings of the run that wrote a folder, by key; none where there was none."""
    path = folder / "config.yaml"
    if not path.is_file():
        return {}
    stored = OmegaConf.load(path)
    return {str(key): stored[key] for key in stored} if isinstance(stored, DictConfig) else {}


def _check_settings(config: DictConfig, before: Mapping[str, Any], folder: Path) -> None:
    """Refuse to mix results of other settings into a folder.

    Raises:
        ArgumentError: a setting that changes what frames become is another.
    """
    wrong = [key for key in before if key in config and key not in FREE and before[key] != config[key]]
    if wrong:
        told = ", ".join(f"{key} was {before[key]}, is {config[key]}" for key in wrong)
        raise ArgumentError(
            f"skip_existing: {folder} holds results of other settings ({told}); set them as before, or give another "
            "output="
        )


def _left_to_do(
    names: list[str] | None, folder: Path, config: DictConfig, settings: Settings
) -> set[str] | None:
    """The frames that are to be done: with ``skip_existing`` those whose last file is not there yet."""
    if names is None or not config.skip_existing:
        return None if names is None else set(names)
    files: dict[str, Any] = {name: done_file(folder, name, settings.outputs) for name in names}
    left = {name for name, file in files.items() if file is None or not file.is_file()}
    console.print(f"{len(names) - len(left)} frame(s) are in {folder} already", soft_wrap=True)
    return left


def _other_size(rig: CameraRig, sizes: dict[str, tuple[int, int]]) -> str:
    name = next(name for name, size in sizes.items() if size != rig.cameras[name].image_size)
    (height, width), (h, w) = sizes[name], rig.cameras[name].image_size
    return (
        f"Warning: images of {name} have {width} x {height} pixels (width x height), the calibration is for {w} x {h}. "
        "They are taken as the whole image resized; if they are a part of it, depth will be wrong: crop the "
        "calibration, or capture at its size."
    )
