# SPDX-License-Identifier: Apache-2.0
"""Depth of captures: image files, videos or live cameras in; pictures, points, arrays and a video out."""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
from annotated_types import Ge
from omegaconf import OmegaConf
from pydantic.dataclasses import dataclass
from torch import Tensor

from sphericalvision.cameras import CameraRig, Trajectory, read_rig, save_rig
from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.cameras.robot_frame import placed, tilt_of
from sphericalvision.cameras.trajectory import upright_turn
from sphericalvision.capture import Predictor, align_rig
from sphericalvision.capture.checks import pose_agreement
from sphericalvision.capture.estimating import Estimate, estimate_frames, ordered_map
from sphericalvision.capture.leveling import leveling_turn
from sphericalvision.capture.outputs import Outputs
from sphericalvision.capture.predictor import with_own
from sphericalvision.capture.preparation.nearest import checked_min_depth
from sphericalvision.capture.preparation.preparation import Preparation
from sphericalvision.capture.result_folder import Settings
from sphericalvision.capture.sources.frames import Selection, Source
from sphericalvision.capture.sources.moving import STILL, Moving
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.io.files import part_of_name
from sphericalvision.io.images import write_mask
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.models.weights.files import identity_of
from sphericalvision.models.weights.pretrained import DEFAULT
from sphericalvision.recipes.app.captures import AUTO, FLOOR, PosedCapture
from sphericalvision.recipes.app.checks import flat
from sphericalvision.recipes.app.cli import (
    check_settings,
    choose_device,
    console,
    print_config,
    read_settings,
    say,
    track,
)
from sphericalvision.recipes.app.kinds import STRICT, Count, Device, Fraction, OnlyWith, Positive, Text
from sphericalvision.sphere.intake import as_photographs

if TYPE_CHECKING:
    from sphericalvision.capture.hint_files import HintFiles

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
    min_confidence: Annotated[Fraction, WITH_SURFACE]
    voxel: Annotated[Positive | None, WITH_POINTS]
    output: Text
    skip_existing: bool
    on_error: Literal["skip", "stop"]
    device: Device


MAX_PATHS = 30
"""Files that are named at the end."""
LAST: Literal["last"] = "last"
"""Hint in place of a pattern: the depth of the frame before."""
SETTINGS, ALIGNED = "config.yaml", "aligned.yaml"
"""Files next to the results: the settings of the run, and the calibration with cameras turned."""
BASIS = "made_from"
"""Key in ``config.yaml``: identities of the rig, the trajectory and the network, whose paths alone say little."""
LYING = math.radians(45)
"""Angle between the cameras' mean down and the world's from which on a warning is printed."""
INVERTED = 1.05
"""Ratio of agreements from which on a trajectory seems to be inverted: of a walk straight ahead it is 1.11, of one with
turns 1.8."""
FREE = ("frames", "start", "stop", "every", "outputs", "output", "skip_existing", "on_error", "device")
"""Settings that may change between runs into one folder."""


def predict(config: PredictConfig, folder: Path) -> list[Path]:
    """Write ``config.outputs`` of each frame to ``folder``; returns the files.

    Raises:
        ArgumentError: the folder holds results of other settings.
        FileFormatError: images of some frames cannot be read; the others are done before that is reported.
    """
    earlier = read_settings(folder / SETTINGS)
    source = open_frames(config)
    calibrated = source.source if isinstance(source, Moving) else source  # whose rig all frames have
    placement = config.capture.placement(calibrated.rig)
    calibrated.rig = placed(calibrated.rig, placement)
    # Masks and fields of view that the images add follow from them, and are no settings of their own.
    basis = identities(config, source.rig)
    config.capture.restrict(calibrated)
    warn_if_lying(config, source.rig)
    warn_if_inverted(source, config.capture.upwards)

    predictor = predictor_for(source.rig, config)
    min_depth = nearest(predictor, source, config, earlier)
    if predictor.min_depth is None and not isinstance(min_depth, str):
        predictor = predictor.with_changes(min_depth=min_depth)
    if config.method == "network" and predictor.min_depth is not None:
        basis["network"] = identity_of(predictor.network)
    settings = {**flat(config), "min_depth": min_depth, BASIS: basis}
    check_settings(folder, earlier, settings, (*FREE, BASIS))
    check_settings(folder, earlier.get(BASIS) or {}, basis)

    if config.capture.up == FLOOR:
        rotation = floor_turn(predictor, source)
        placement = rotation.to(placement) @ placement
        calibrated.rig = placed(calibrated.rig, rotation)
        predictor = predictor.with_changes(source.rig)
    aligned = aligned_rig(predictor, calibrated, folder, bool(earlier) and config.skip_existing, placement)
    if aligned is not None:
        calibrated.rig = aligned
        predictor = predictor.with_changes(source.rig)
    hints = hints_of(config, source, predictor, placement)
    write_settings(settings, predictor, folder)
    for name, mask in calibrated.rig.masks.items() if config.capture.masks == AUTO else ():
        write_mask(folder / "masks" / f"{part_of_name(name)}.png", mask)

    outputs = Outputs(folder, output_settings(config, source))
    names = source.names(config.capture.selection)
    remaining = None if names is None else outputs.remaining(names)
    if names is not None and remaining is not None and len(remaining) < len(set(names)):
        say(f"{len(set(names)) - len(remaining)} frame(s) are complete in {folder} already; skipping them")
    try:
        selection, stop_on_error = config.capture.selection, config.on_error == "stop"
        errors = run(source, selection, predictor, outputs, remaining, stop_on_error, hints)
    finally:
        if not outputs.count and not earlier:  # there are no results that other settings could mix with
            (folder / SETTINGS).unlink(missing_ok=True)
    written = [path for path in [folder / ALIGNED] if path.is_file()] + outputs.written
    report(written, outputs)
    for note in source.notes:
        print(f"Warning: {note}")
    if errors:
        count = "some" if names is None else f"{len(errors)} of {len(names)}"
        raise FileFormatError(f"{count} frames were left out. The first: {errors[0]}")
    return written


def predictor_for(rig: CameraRig, config: PredictConfig) -> Predictor:
    """The predictor that a configuration describes.

    Raises:
        ArgumentError: the network needs another number of cameras.
    """
    net = with_own(read_network(config.checkpoint), False, num_hypotheses=config.num_hypotheses)
    net.trained_radius = config.trained_radius
    return Predictor(
        rig,
        net,
        method=config.method,
        min_depth=config.min_depth,
        level=config.level,
        device=choose_device(config.device),
        preparation=config.preparation,
    )


def open_frames(config: PredictConfig) -> Source:
    """The frames of a configuration, with the rig of each in the size of its images; prints how many there are."""
    source = config.capture.open()
    if isinstance(source, Moving):
        print(f"Poses: image {source.first_pair[0]} has the pose {source.first_pair[1]}, and so on.")
        if source.unposed:
            print(
                f"Warning: {source.unposed} frame(s) have no pose within 20 ms, or of their name; left out."
            )
    names = source.names(config.capture.selection)
    count = "live" if names is None else f"{len(names)} frame(s)"
    cameras = "cameras" if config.capture.poses is None else "images in a window"
    console.print(f"{count}, {len(source.rig)} {cameras}, rig radius {float(source.rig.radius):.3f} m")
    return source


def warn_if_lying(config: PredictConfig, rig: CameraRig) -> None:
    """Print a warning where the cameras' mean down is far from the world's: panoramas would lie on their side."""
    tilt, capture = tilt_of(rig), config.capture
    if tilt is None or tilt < LYING:
        return
    remedy = (
        f"frame={capture.frame} should place the rig in axes x forward, y left, z up"
        if capture.frame
        else "set up=z (robots, IMUs) or up=y if that points up in the calibration, or up=camera for the images' up"
    )
    print(
        f"Warning: the cameras' mean down is {math.degrees(tilt):.0f}° from the world's down (up={capture.upwards}); "
        f"then panoramas lie on their side, and depth is worse: {remedy}."
    )


def warn_if_inverted(source: Source, up: str) -> None:
    """Print a warning where a few windows' images agree better with the inverse of the poses in the file."""
    if not isinstance(source, Moving) or up not in ("-y", "y", "z"):
        return
    poses = source.poses  # turned already: those in the file are the inverse of the turn times these
    rotation = upright_turn(up, poses.world_from_camera).to(poses.world_from_camera)
    inverse = Trajectory(poses.names, torch.linalg.inv(poses.world_from_camera) @ rotation)
    agreements = torch.zeros(2)
    for frame in source.samples():
        if frame.images is None or frame.rig is None:
            continue
        images = as_photographs(frame.images, frame.rig)
        rigs = [
            trajectory.rig(source.source.rig, source.windows[frame.name]) for trajectory in (poses, inverse)
        ]
        if min(float(rig.radius) for rig in rigs) > STILL:
            agreements += torch.tensor([pose_agreement(images, rig) for rig in rigs])
    if agreements[1] > INVERTED * agreements[0]:
        print(
            f"Warning: poses: the images agree better ({agreements[1] / agreements[0]:.2f} times) when they are "
            "inverted: the trajectory seems to hold camera-from-world where world-from-camera is expected; invert it."
        )


def identities(config: PredictConfig, rig: CameraRig) -> dict[str, str | None]:
    """Fingerprints of the rig and of the trajectory: the same paths may lead to other files later on."""
    poses = Path(config.capture.poses or "")
    trajectory = f"{zlib.crc32(poses.read_bytes()):08x}" if poses.is_file() else None
    return {"rig": rig_fingerprint(rig, digits=6), "trajectory": trajectory}


def nearest(
    predictor: Predictor, source: Source, config: PredictConfig, earlier: Mapping[str, Any]
) -> float | str:
    """The nearest hypothesis: as configured, of the run that is continued, or found in a few frames."""
    if predictor.min_depth is not None:
        return config.min_depth
    if config.skip_existing and not isinstance(earlier.get("min_depth", ""), str):
        return checked_min_depth(earlier["min_depth"])
    samples = [(frame.images, frame.rig) for frame in source.samples() if frame.images is not None]
    shared = [images for images, rig in samples if rig is None]
    depths = [predictor.nearest_depth(shared)] if shared else []
    # Windows have rigs of their own, and share the depth.
    depths += [
        predictor.with_changes(rig).nearest_depth([images]) for images, rig in samples if rig is not None
    ]
    return round(min(depths), 3) if depths else config.min_depth


def floor_turn(predictor: Predictor, source: Source) -> Tensor:
    """``(4, 4)``, which levels a rig by the floor in the depth of a few frames; prints by how much."""
    depths = (predictor(frame.images) for frame in source.samples() if frame.images is not None)
    rotation, sentence = leveling_turn(depths)
    say(f"up=floor: {sentence}")
    return rotation


def aligned_rig(
    predictor: Predictor, source: Source, folder: Path, goes_on: bool, placement: Tensor
) -> CameraRig | None:
    """The rig of ``source`` with cameras turned where three frames show it; None if it stays as it is.

    The calibration with these cameras turned goes to ``aligned.yaml``, which a continuation (``goes_on``) takes;
    ``placement`` ``(4, 4)`` is from its frame to that of the rig.
    """
    path = folder / ALIGNED
    if not goes_on:
        path.unlink(missing_ok=True)
        if not predictor.preparation.judges(source.rig):
            return None
        if predictor.rig.names != source.rig.names:  # of windows
            predictor = predictor.with_changes(source.rig)
        start = time.perf_counter()
        with console.status("comparing frames with the calibration"):
            verdict = align_rig(predictor, (f.images for f in source.samples() if f.images is not None))
        say(f"preparation {verdict.described()} ({time.perf_counter() - start:.1f} s)")
        if verdict.turned:
            save_rig(placed(verdict.rig.to("cpu"), torch.linalg.inv(placement)), path)
    if not path.is_file():
        return None
    # The first run takes it from the file as well: placed there and back it differs in the last digits.
    turned = placed(read_rig(path), placement)
    return source.rig.replaced(world_from_camera=turned.world_from_camera, origin=turned.origin)


def hints_of(
    config: PredictConfig, source: Source, predictor: Predictor, placement: Tensor
) -> HintFiles | Literal["last"] | None:
    """The hints of a configuration.

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

    quantity, fit = config.hint_quantity, config.hint_fit
    return HintFiles(config.hint, names, source.rig, placement, quantity, fit, source.whole.names)


def output_settings(config: PredictConfig, source: Source) -> Settings:
    """Settings of the results; without ``outputs`` a video of streams, else files of frames."""
    return Settings(
        config.outputs or (("depth", "cloud", "npz") if source.rate == 0 else ("video",)),
        config.height,
        config.min_confidence,
        config.voxel,
        rate=(source.rate or 10.0) / config.capture.every,
        near=config.near,
        go_on=config.skip_existing,
        axes=config.capture.axes,
        posed=config.capture.poses is not None,
    )


def write_settings(settings: Mapping[str, Any], predictor: Predictor, folder: Path) -> None:
    """Print the settings, and keep them in the folder."""
    print_config(OmegaConf.create(dict(settings)), folder)
    nearest = "found in the first frame" if predictor.min_depth is None else f"{predictor.min_depth:.3f} m"
    weights = f", weights {settings['checkpoint'] or DEFAULT}" if settings["method"] == "network" else ""
    console.print(f"nearest hypothesis {nearest}{weights}")


def run(
    source: Source,
    selection: Selection,
    predictor: Predictor,
    outputs: Outputs,
    remaining: set[str] | None,
    stop_on_error: bool = False,
    hints: HintFiles | Literal["last"] | None = None,
) -> list[str]:
    """Write the depth of frame after frame, while the next ones are estimated; returns the errors.

    Args:
        remaining: names of the frames to be done; None for all of them.
        stop_on_error: whether to raise the error of a frame that cannot be read.
        hints: of ``estimate_frames``.
    """

    def selected(name: str) -> bool:
        return remaining is None or name in remaining

    def write(estimate: Estimate) -> Estimate:
        if estimate.depth is not None:
            outputs.write(estimate.frame.name, estimate.depth)
        return estimate

    errors: list[str] = []
    count, busy, began = 0, 0.0, time.perf_counter()
    total = None if remaining is None else len(remaining)
    estimates = estimate_frames(source, selection, predictor, selected, total, hints)
    try:
        with (
            closing(ordered_map(write, estimates, 1, waiting=2, finish=True)) as results,
            closing(estimates),  # type: ignore[type-var]
        ):
            chosen = (result for result in results if selected(result.frame.name))
            for frame, depth, seconds in track(chosen, "estimating depth", total):
                if depth is not None:
                    if not count:
                        for sentence in depth.compensations[0].described() if depth.compensations else ():
                            say(f"preparation {sentence} (in the first frame)")
                    count, busy = count + 1, busy + seconds
                elif stop_on_error and frame.error is not None:
                    raise frame.error
                else:
                    if str(frame.error) not in errors:  # many frames may be missing for one reason
                        say(f"left out: {frame.error}", style="yellow")
                    errors.append(str(frame.error))
    except KeyboardInterrupt:
        if not source.live:  # live cameras have no other end
            raise
    finally:
        outputs.close()
    took = time.perf_counter() - began
    if count:
        fraction = f"the network busy {100 * busy / took:.0f} % of the time"
        say(f"{count} frame(s) in {took:.1f} s: {count / took:.2f} frames/s, {fraction}")
    return errors


def report(written: list[Path], outputs: Outputs) -> None:
    """Print the files, and the results of all frames together."""
    for path in written[:MAX_PATHS]:
        print(path)
    if len(written) > MAX_PATHS:
        print(f"... {len(written)} files in {outputs.results.path}")
    for sentence in outputs.described():
        print(sentence)
