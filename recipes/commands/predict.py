# SPDX-License-Identifier: Apache-2.0
"""Depth of one's own captures: image files, videos or live cameras in; pictures, points, arrays and a video out."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
from annotated_types import Ge
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic.dataclasses import dataclass
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor

from sphericalvision.cameras import CameraRig, read_rig, save_rig
from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.cameras.robot_frame import placed, tilt_of
from sphericalvision.capture import Predictor, align_rig
from sphericalvision.capture.estimating import Behind, Estimate, estimate_frames
from sphericalvision.capture.folder_record import RECORD, checksum
from sphericalvision.capture.leveling import leveling_turn
from sphericalvision.capture.outputs import Outputs, Settings
from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.capture.sources.frames import Selection, Source
from sphericalvision.capture.sources.moving import Moving
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.io.yaml_files import read_yaml
from sphericalvision.models.weights.files import identity_of
from sphericalvision.models.weights.pretrained import DEFAULT
from sphericalvision.recipes.app.captures import AUTO, FLOOR, PosedCapture, cut_to_visible, masked_by_itself
from sphericalvision.recipes.app.checks import flat
from sphericalvision.recipes.app.cli import choose_device, console, print_config, say
from sphericalvision.recipes.app.kinds import STRICT, Count, Device, OnlyWith, Positive, Share, Text

if TYPE_CHECKING:
    from sphericalvision.capture.hint_files import HintFiles

__all__ = ["PredictConfig", "open_frames", "predict", "predictor_for"]


WITH_POINTS = OnlyWith("outputs=cloud|glb|fused|splat", "outputs=[cloud], [glb], [fused] or [splat]")
WITH_SURFACE = OnlyWith(
    "outputs=cloud|glb|mesh|fused|splat", "outputs=[cloud], [glb], [mesh], [fused] or [splat]"
)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class PredictConfig:
    """Keys of ``conf/predict.yaml``."""

    capture: PosedCapture
    preparation: Preparation
    method: Literal["network", "semi_global"]
    checkpoint: Text | None
    num_hypotheses: Annotated[int, Ge(2)] | None
    level: Count | None
    hint: Text | None
    hint_quantity: Annotated[Literal["range", "z"], OnlyWith("hint")]
    hint_fit: Annotated[Literal["metres", "scale", "affine"], OnlyWith("hint")]
    min_depth: Positive | Literal["auto", "scene"]
    trained_radius: Annotated[Positive, OnlyWith("min_depth=auto")]
    outputs: list[str] | None
    height: Count
    near: Positive | None
    min_confidence: Annotated[Share, WITH_SURFACE]
    voxel: Annotated[Positive | None, WITH_POINTS]
    output: Text
    skip_existing: bool
    on_error: Literal["skip", "stop"]
    device: Device


MOST_PATHS = 30
"""Of files that are named at the end."""
ENOUGH = 0.9
"""Share of the sphere that two cameras see, below which it is said."""
LAST: Literal["last"] = "last"
"""As a hint: the depth of the frame before."""
ANEW = "give another output=, or leave skip_existing out to make all frames anew"
ALIGNED = "aligned.yaml"
"""Beside the results: the calibration with cameras turned."""
LYING = math.radians(45)
"""Between the cameras' mean down and the world's, from which on it is said."""
FREE = (
    *("frames", "start", "stop", "every", "outputs", "output"),
    *("skip_existing", "on_error", "device"),
)
"""Settings that may change between a prediction and its continuation."""


def predictor_for(rig: CameraRig, config: PredictConfig) -> Predictor:
    """The predictor that a configuration describes.

    Raises:
        ArgumentError: the network wants another number of cameras.
    """
    return Predictor(
        rig,
        config.checkpoint,
        method=config.method,
        min_depth=config.min_depth,
        level=config.level,
        num_hypotheses=config.num_hypotheses,
        device=choose_device(config.device),
        preparation=config.preparation,
        trained_radius=config.trained_radius,
    )


def open_frames(config: PredictConfig) -> Source:
    """The frames that a configuration names, with the rig of each in the size of its images."""
    source = config.capture.open()
    if isinstance(source, Moving):
        print(f"Poses: image {source.first_pair[0]} has the pose {source.first_pair[1]}, and so on.")
        if source.unposed:
            print(
                f"Warning: {source.unposed} frame(s) have no pose within 20 ms, or of their name; left out."
            )
    return source


def _say_if_lying(rig: CameraRig, capture: PosedCapture) -> None:
    """Print a warning where the cameras' mean down is far from the world's, in which panoramas lie on their side."""
    tilt = tilt_of(rig)
    if tilt is None or tilt < LYING:
        return
    what = (
        f"frame={capture.frame} should place the rig in axes x forward, y left, z up"
        if capture.frame
        else "up=z (robots, IMUs) or up=y, if that points up there; up=camera takes what is up in the images"
    )
    print(
        f"Warning: the cameras' mean down is {math.degrees(tilt):.0f}° from the world's down, with "
        f"up={capture.upwards}. If it is not so, pictures lie on their side and depth is worse: {what}."
    )


def hints_of(
    config: PredictConfig, source: Source, predictor: Predictor, placement: Tensor
) -> HintFiles | Literal["last"] | None:
    """The hints that a configuration names.

    Raises:
        ArgumentError: the network takes none of files, there is no pose to carry the last frame's depth on, or a key
            does not count.
    """
    if config.hint is None:
        return None
    moving = isinstance(source, Moving)
    if config.hint == LAST:
        if not moving:
            raise ArgumentError(
                "hint: last carries the depth of the frame before on by the rig's poses; give poses=, or leave hint out"
            )
        for key, usual in {"hint_quantity": "range", "hint_fit": "metres"}.items():
            if getattr(config, key) != usual:
                raise ArgumentError(
                    f"{key}: is for hints in files, not for the depth of the last frame; leave it out"
                )
        return LAST
    predictor.check_takes_hints()
    names = source.names(config.capture.selection)
    if moving or names is None:
        raise ArgumentError(
            "hint: files are for frames of a rig, not of windows with poses= or live cameras; leave hint out"
        )
    from sphericalvision.capture.hint_files import HintFiles

    quantity, fit, whole = config.hint_quantity, config.hint_fit, source.whole.names
    return HintFiles(config.hint, names, source.rig, placement, quantity, fit, whole)


def nearest(
    predictor: Predictor, source: Source, config: PredictConfig, before: Mapping[str, Any]
) -> PredictConfig:
    """The configuration with its nearest hypothesis: of the run that it continues, or found in a few frames."""
    if "min_depth" in before:
        return replace(config, min_depth=before["min_depth"])
    if samples := source.samples():
        shared = [frame.images for frame in samples if frame.images is not None and frame.rig is None]
        depths = [predictor.nearest_depth(shared)] if shared else []
        for frame in samples:  # windows have rigs of their own, and share the depth
            if frame.images is not None and frame.rig is not None:
                depths.append(predictor.with_changes(frame.rig).nearest_depth([frame.images]))
        return replace(config, min_depth=round(min(depths), 3))
    return config


def aligned(
    predictor: Predictor, source: Source, folder: Path, goes_on: bool, placement: Tensor
) -> Predictor:
    """The predictor with cameras turned where three frames say so; the calibration goes to ``aligned.yaml``.

    Whoever goes on with a prediction takes what is there.

    Args:
        predictor: of the rig.
        source: of its frames.
        folder: of the results.
        goes_on: whether there are results already.
        placement: ``(4, 4)``, from the frame of the calibration to that of the rig.
    """
    path = folder / ALIGNED
    if goes_on:
        if not path.is_file():
            return predictor
        turned = placed(read_rig(path), placement)
        source.rig = source.rig.replaced(world_from_camera=turned.world_from_camera, origin=turned.origin)
        return predictor.with_changes(source.rig)
    if not predictor.preparation.align:
        return predictor
    start = time.perf_counter()
    with console.status("comparing frames with the calibration"):
        verdict = align_rig(predictor, (f.images for f in source.samples() if f.images is not None))
    say(f"preparation {verdict.described()} ({time.perf_counter() - start:.1f} s)")
    if not verdict.turned:
        return predictor
    source.rig = verdict.rig.to("cpu")
    folder.mkdir(parents=True, exist_ok=True)
    save_rig(placed(source.rig, torch.linalg.inv(placement)), path)
    return predictor.with_changes(source.rig)


def predict(config: PredictConfig, folder: Path) -> list[Path]:
    """Write what ``config.outputs`` names of each frame to ``folder``; returns the files.

    Raises:
        FileFormatError: images of some frames cannot be read; the others are done before that is told.
    """
    source = open_frames(config)
    selection = config.capture.selection
    names = source.names(selection)
    many = "live" if names is None else f"{len(names)} frame(s)"
    cameras = "cameras" if config.capture.poses is None else "images in a window"
    radius = float(source.rig.radius)
    console.print(f"{many}, {len(source.rig)} {cameras}, rig radius {radius:.3f} m")
    still = source.source if isinstance(source, Moving) else source  # whose frames are made ready once
    if config.capture.masks == AUTO:
        still.rig = masked_by_itself(still, folder)
    placement = config.capture.placement(still.rig)
    still.rig = placed(still.rig, placement)
    _say_if_lying(source.rig, config.capture)
    before = _settings_before(folder) if config.skip_existing else {}
    basis = _basis(config, source.rig)
    cut_to_visible(still, config.capture.max_angle_deg)
    predictor = predictor_for(source.rig, config)
    if predictor.min_depth is None:
        config = nearest(predictor, source, config, before)
        if not isinstance(config.min_depth, str):
            predictor = predictor.with_changes(min_depth=config.min_depth)
    _check_settings(config, before, folder)
    if config.capture.up == FLOOR:
        depths = (predictor(frame.images) for frame in source.samples() if frame.images is not None)
        turn, sentence = leveling_turn(depths)
        say(f"up=floor: {sentence}")
        placement = turn.to(placement) @ placement
        source.rig = placed(source.rig, turn)
        predictor = predictor.with_changes(source.rig)
    hints = hints_of(config, source, predictor, placement)
    if still is source:
        predictor = aligned(predictor, source, folder, bool(before), placement)
        if hints is not None and hints != LAST:
            hints.rig = source.rig  # their depth images are turned as the cameras are
    elif predictor.preparation.judges(still.rig):
        aligned(predictor.with_changes(still.rig), still, folder, bool(before), placement)
        predictor = predictor.with_changes(source.rig)
    if not before:  # what it states is of other settings than those that come now
        (folder / RECORD).unlink(missing_ok=True)
    print_config(config, folder)
    near = "found in the first frame" if predictor.min_depth is None else f"{predictor.min_depth:.3f} m"
    weights = f", weights {config.checkpoint or DEFAULT}" if config.method == "network" else ""
    console.print(f"nearest hypothesis {near}{weights}")
    kinds = config.outputs or (("depth", "cloud", "npz") if source.rate == 0 else ("video",))
    settings = Settings(
        list(kinds),
        config.height,
        config.min_confidence,
        config.voxel,
        (source.rate or 10.0) / config.capture.every,
        config.near,
        bool(before),
        {**basis, "network": identity_of(predictor.network) if config.method == "network" else None},
        config.capture.axes,
        config.capture.poses is not None,
    )
    outputs = Outputs(folder, settings)
    if (folder / ALIGNED).is_file():
        outputs.written.append(folder / ALIGNED)
    remaining = None if names is None else set(names)
    if names is not None and before:
        remaining = outputs.remaining(names)
        say(f"{len(set(names)) - len(remaining)} frame(s) are in {folder} already, in each of its outputs")
    wrong = run(source, selection, predictor, outputs, remaining, config.on_error == "stop", hints)
    _report(outputs)
    for note in source.notes:
        print(f"Warning: {note}")
    if wrong:
        number = "some" if names is None else f"{len(wrong)} of {len(names)}"
        raise FileFormatError(f"{number} frames were left out. The first: {wrong[0]}")
    return outputs.written


def run(
    source: Source,
    selection: Selection,
    predictor: Predictor,
    outputs: Outputs,
    remaining: set[str] | None,
    stop_on_error: bool = False,
    hints: HintFiles | Literal["last"] | None = None,
) -> list[str]:
    """Write the depth of frame after frame, while the next ones are estimated; returns what was wrong.

    Args:
        source: of the frames.
        selection: which of them.
        predictor: of their depth.
        outputs: where depth goes.
        remaining: names of the frames to be done; None for all of them.
        stop_on_error: whether to raise the error of a frame that cannot be read.
        hints: of ``estimate_frames``.
    """
    # Colours follow the first frame of all: whoever goes on looks at that one once more, and only then at what is left.
    needs_first = bool(remaining) and outputs.follows_first_frame

    def is_remaining(name: str) -> bool:
        return remaining is None or name in remaining

    def is_needed(name: str) -> bool:
        return is_remaining(name) or (needs_first and outputs.near is None)

    wrong: list[str] = []
    number, busy, began = 0, 0.0, time.perf_counter()
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[speed]}"), TimeRemainingColumn())
    total = None if remaining is None else len(remaining)
    estimates = estimate_frames(source, selection, predictor, is_needed, total, hints)
    try:
        with (
            closing(estimates),  # type: ignore[type-var]
            Progress(
                TextColumn("estimating depth"), *columns, console=console, refresh_per_second=4
            ) as progress,
            Behind[Estimate](lambda done: outputs.write(done.frame.name, done.depth)) as behind,  # type: ignore[arg-type]
        ):
            task = progress.add_task("", total=total, speed="")
            for frame, depth, seconds in estimates:
                if depth is not None:
                    if outputs.is_new:
                        for sentence in depth.compensations[0].described() if depth.compensations else ():
                            say(f"preparation {sentence} (in the first frame)")
                    outputs.begin(depth)
                if not is_remaining(frame.name):
                    continue
                if depth is not None:
                    busy += seconds
                    behind.put(Estimate(frame, depth))
                    number += 1
                elif stop_on_error and frame.error is not None:
                    raise frame.error
                else:
                    if str(frame.error) not in wrong:  # many frames may be missing for one reason
                        say(f"left out: {frame.error}", style="yellow")
                    wrong.append(str(frame.error))
                speed = f"{number / (time.perf_counter() - began):.2f} frames/s"
                progress.update(task, advance=1, speed=speed)
    except KeyboardInterrupt:
        if not source.live:  # live cameras have no other end
            raise
    finally:
        outputs.close()
    took = time.perf_counter() - began
    if number:
        share = f"the network busy {100 * busy / took:.0f} % of the time"
        say(f"{number} frame(s) in {took:.1f} s: {number / took:.2f} frames/s, {share}")
    return wrong


def _report(outputs: Outputs) -> None:
    """Print the files, and what is to be known of all frames together."""
    for path in outputs.written[:MOST_PATHS]:
        print(path)
    if len(outputs.written) > MOST_PATHS:
        print(f"... {len(outputs.written)} files in {outputs.folder}")
    if shares := outputs.consistency.values():
        mean = sum(shares) / len(shares)
        print(
            f"photo-consistency: {mean:.3f} of what winner-takes-all reaches, mean of {len(shares)} frame(s)"
        )
    if outputs.seam > 0:
        print(
            f"panorama: seams are at the depth estimated, {outputs.seam:.2f} m (median of the first frame, where two "
            "cameras see); what is nearer or farther than its estimate is seen twice there, or cut off"
        )
    if outputs.fused is not None and "fused" in outputs.settings.outputs:
        points, frames = len(outputs.fused.points().points), len(outputs.fused.frames)
        print(
            f"fused: {points} points of {frames} frame(s), one for each cube of {100 * outputs.fused.side:.1f} cm that "
            f"frames agree on, of {len(outputs.fused)}{'' if points else '; a larger voxel= has some'}"
        )
    for warning in outputs.warnings:
        print(f"Warning: {warning}")
    if outputs.shares and min(outputs.shares) < ENOUGH:
        print(
            f"Two cameras see {100 * min(outputs.shares):.0f} % of all directions at the depth estimated. Elsewhere "
            "nothing can be measured: grey in pictures, left out of point clouds, False in matched_panorama of arrays."
        )


def _basis(config: PredictConfig, rig: CameraRig) -> dict[str, str | None]:
    """What the files hold that settings name: the same path may lead to another calibration or trajectory later on."""
    rig = rig.replaced(masks={}) if config.capture.masks == AUTO else rig  # which follow from the frames
    poses = config.capture.poses
    return {
        "rig": rig_fingerprint(rig, digits=6),
        "trajectory": None if poses is None else str(checksum(Path(poses))),
    }


def _settings_before(folder: Path) -> dict[str, Any]:
    """Settings of the run that wrote a folder, by key; none where there was none.

    Raises:
        FileFormatError: the file that has them is damaged.
    """
    path = folder / "config.yaml"
    if not path.is_file():
        return {}
    try:
        stored = read_yaml(path)
        stored = OmegaConf.create(stored if isinstance(stored, dict) else {})
        settings = {str(key): stored[key] for key in stored}
    except (FileFormatError, OmegaConfBaseException, OSError) as error:
        raise FileFormatError(f"{path}: is damaged ({error}); {ANEW}") from None
    if not settings:
        raise FileFormatError(f"{path}: expected the settings of the run that wrote it, got none; {ANEW}")
    return settings


def _check_settings(config: PredictConfig, before: Mapping[str, Any], folder: Path) -> None:
    """Refuse to mix results of other settings into a folder.

    Raises:
        ArgumentError: a setting that changes what frames become is another.
    """
    now = OmegaConf.create(flat(config))
    wrong = [key for key in before if key in now and key not in FREE and before[key] != now[key]]
    if wrong:
        changes = ", ".join(f"{key} was {before[key]}, is {now[key]}" for key in wrong)
        raise ArgumentError(
            f"skip_existing: {folder} holds results of other settings ({changes}); set them as before, or give another "
            "output="
        )
