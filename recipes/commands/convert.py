# SPDX-License-Identifier: Apache-2.0
"""Cameras as another model or file, or beside another calibration: ``sphericalvision-convert calibration=a.yaml
to=kannala_brandt output=b.yaml``, ``calibration=a.yaml with=b.yaml``."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated

import torch
from pydantic.dataclasses import dataclass

from sphericalvision.cameras import (
    Camera,
    CameraRig,
    compare_cameras,
    field_of_view,
    save_camera,
    save_rig,
    straighten,
    straighten_rig,
)
from sphericalvision.cameras.calibration import CAMERA_FORMATS, RIG_FORMATS
from sphericalvision.cameras.conversion.convert import Conversion
from sphericalvision.cameras.conversion.convert import convert as convert_camera
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.geometry import invert_transform
from sphericalvision.geometry.transforms import axis_angle_from_transform
from sphericalvision.recipes.app.cli import console, print_table
from sphericalvision.recipes.app.kinds import STRICT, Count, HalfAngle, OnlyWith, Text
from sphericalvision.recipes.app.rigs import Calibration, keys_named


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ConvertConfig:
    """Keys of ``conf/convert.yaml``."""

    file: Calibration
    with_: Text | None
    to: Text | None
    output: Text | None
    format: Annotated[Text | None, OnlyWith("output")]
    camera: Text | int | None
    num_coefficients: Annotated[Count | None, OnlyWith("to")]
    projection: Annotated[Text | None, OnlyWith("to")]
    fit_angle_deg: Annotated[HalfAngle | None, OnlyWith("to")]


def convert(config: ConvertConfig) -> dict[str, Conversion]:
    """Convert the cameras of ``config.file.calibration``, print how well that went, and write ``config.output``; or
    print how they differ from those of ``config.with_``.
    """
    every, rig = config.file.cameras_and_rig(torch.float64)
    cameras = every
    if config.camera is not None:
        name = str(config.camera)
        if name not in every:
            raise ArgumentError(
                f"camera: expected one of {', '.join(every)}, the cameras of {config.file.calibration}, got "
                f"{config.camera!r}"
            )
        cameras = {name: every[name]}
    if config.with_ is not None:
        _compare(config, list(every), rig, cameras)
        return {}
    if config.camera is not None:
        rig = None
    if config.to not in (None, "ocam"):
        angles = {name: straighten(camera).angle for name, camera in cameras.items()}
        if rig is not None:
            rig = straighten_rig(rig)
            cameras = rig.cameras
            _tell_turns(angles, "is a turn of its pose now")
        else:
            _tell_turns(angles, "no other model has, and without a pose nothing else can take it up")
    if config.format is not None:
        check_choice("format", config.format, CAMERA_FORMATS if rig is None else RIG_FORMATS)
    converted = {name: _converted(name, camera, config) for name, camera in cameras.items()}
    _print(config, cameras, converted)
    if config.output is None:
        console.print("Nothing is written; give output=... for that.")
        return converted
    new = {name: conversion.camera for name, conversion in converted.items()}
    if rig is not None:
        save_rig(rig.replaced(new), config.output, config.format)
    elif len(new) == 1:
        save_camera(next(iter(new.values())), config.output, config.format)
    else:
        raise ArgumentError(
            f"camera: {config.file.calibration} has {len(new)} cameras without poses; choose one of {', '.join(new)} "
            "to write it"
        )
    print(config.output)
    return converted


def _compare(
    config: ConvertConfig, names: list[str], rig: CameraRig | None, cameras: Mapping[str, Camera]
) -> None:
    """Print how far the cameras of two calibrations are apart, by the angle from the axis, and their poses.

    Args:
        names: of all cameras of the first calibration.
        rig: of the first calibration.
        cameras: those that are compared.
    """
    assert config.with_ is not None
    if wrong := [key for key in ("to", "output") if getattr(config, key) is not None]:
        raise ArgumentError(f"{wrong[0]}: counts only without with=..., which compares and converts nothing")
    with keys_named(calibration="with"):
        others, other = replace(config.file, calibration=config.with_).cameras_and_rig(torch.float64)
    if not set(names) <= set(others) and len(names) == len(others):
        # Files of other programs call cameras otherwise: their order counts.
        pairs = ", ".join(f"{name} with {other}" for name, other in zip(names, others, strict=True))
        console.print(f"By their order: {pairs}.", soft_wrap=True)
        others = dict(zip(names, others.values(), strict=True))
    if lacking := [name for name in cameras if name not in others]:
        raise ArgumentError(
            f"with: expected a camera {lacking[0]} in {config.with_}, it has {', '.join(others)}"
        )
    for name, camera in cameras.items():
        with keys_named(second=f"with, {name}"):
            rings = torch.stack(compare_cameras(camera, others[name])).T
        rings[:, [0, 3, 4]] = rings[:, [0, 3, 4]].rad2deg()
        rows = [
            ["–" if math.isnan(x) else f"{x:.{n}f}" for x, n in zip(row, (1, 3, 3, 4, 4), strict=True)]
            for row in rings.tolist()
        ]
        columns = ["from the axis (°)", "mean (px)", "max (px)", "mean (°)", "max (°)"]
        print_table(f"{name}: {config.file.calibration} and {config.with_}", columns, rows)
    if rig is not None and other is not None and len(rig) > 1:
        if set(names) <= set(other.names):
            other = other.subset(names)
        if len(other) == len(rig):
            _compare_poses(rig, other)


def _compare_poses(rig: CameraRig, other: CameraRig) -> None:
    """Print by how much cameras stand and look elsewhere, as seen from the first one."""
    first, second = (
        invert_transform(each.world_from_camera[0]) @ each.world_from_camera for each in (rig, other)
    )
    angles = axis_angle_from_transform(invert_transform(first) @ second)[0].norm(dim=-1).rad2deg()
    moved = (first[:, :3, 3] - second[:, :3, 3]).norm(dim=-1) * 1000
    rows = [
        [n, f"{a:.3f}", f"{m:.2f}"]
        for n, a, m in zip(rig.names, angles.tolist(), moved.tolist(), strict=True)
    ]
    print_table(f"Poses as seen from {rig.names[0]}", ["camera", "turned (°)", "moved (mm)"], rows)


def _tell_turns(turns: dict[str, float], what: str) -> None:
    for name, angle in turns.items():
        if abs(angle) > 1e-5:
            console.print(
                f"{name}: its image is turned about the axis by {math.degrees(angle):.3f}°, which {what}."
            )


def _converted(name: str, camera: Camera, config: ConvertConfig) -> Conversion:
    if config.to is None:
        return Conversion(camera, 0.0, 0.0, float(camera.max_angle))
    angle = None if config.fit_angle_deg is None else math.radians(config.fit_angle_deg)
    try:
        with keys_named(max_angle="fit_angle_deg"):
            return convert_camera(
                camera,
                to=config.to,
                max_angle=angle,
                num_coefficients=config.num_coefficients,
                projection=config.projection,
            )
    except ArgumentError as error:
        raise ArgumentError(f"{config.file.calibration}, {name}: {error}") from None


def _print(config: ConvertConfig, cameras: Mapping[str, Camera], converted: dict[str, Conversion]) -> None:
    rows = []
    for name, camera in cameras.items():
        new, largest, rms, _ = converted[name]
        before, after = (math.degrees(field_of_view(one).widest) for one in (camera, new))
        models = (camera.model, new.model)
        rows.append([name, *models, f"{before:.1f}°", f"{after:.1f}°", f"{largest:.4f}", f"{rms:.4f}"])
    columns = ["camera", "from", "to", "sees", "kept", "max (px)", "RMS (px)"]
    print_table(str(config.file.calibration), columns, rows)
