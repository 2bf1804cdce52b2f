# SPDX-License-Identifier: Apache-2.0
"""Render a data set in the layout of OmniThings: ``sphericalvision-render output=... num_frames=...``.

Runs fill a folder together, all with the same settings.
"""

from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import MinLen
from pydantic.dataclasses import dataclass
from torch.utils.data import DataLoader

from sphericalvision.cameras import CameraRig, EquirectangularCamera
from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.core import ArgumentError
from sphericalvision.data import write_omnistereo
from sphericalvision.data.omnistereo.releases import RELEASES
from sphericalvision.io.yaml_files import write_yaml
from sphericalvision.recipes.app.cli import (
    build,
    check_settings,
    console,
    print_config,
    read_settings,
    track,
)
from sphericalvision.recipes.app.kinds import STRICT, Count, Number, OnlyWith, Positive, Text
from sphericalvision.scenes.meshes import MeshFiles, mesh_files
from sphericalvision.scenes.samples import recorded_sample
from sphericalvision.scenes.world import NATURAL_MIN_DEPTH, World


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RenderConfig:
    """Keys of ``conf/render.yaml``."""

    rig: Any
    output: Text
    num_frames: Count
    first_frame: Number
    first_seed: Number
    kind: Text | Annotated[list[Text], MinLen(1)]
    mesh: Text | list[str] | None
    mesh_up: Annotated[Literal["y", "z"], OnlyWith("mesh")]
    mesh_scale: Annotated[Positive, OnlyWith("mesh")]
    carrier: Text | None
    release: Literal["png", "tiff"] | None
    min_depth: Positive
    scale: Positive
    samples_per_pixel: Count
    height: Count
    num_workers: Number


def render(config: RenderConfig) -> int:
    """Render the frames that ``config.output`` lacks and return their number; runs of a multirun share the folder."""
    folder = Path(config.output).absolute()
    rig: CameraRig = build(config.rig, "rig")
    panoramas = any(isinstance(camera, EquirectangularCamera) for camera in rig.cameras.values())
    release = config.release or ("tiff" if panoramas else "png")
    frames = range(config.first_frame, config.first_frame + config.num_frames)
    settings, earlier = settings_of(config, rig, release), read_settings(folder / RECORD)
    truths = folder / RELEASES[release].ground_truth_folder
    if not earlier and truths.is_dir() and any(truths.iterdir()):
        raise ArgumentError(
            f"output: {folder} holds frames of unknown settings (no {RECORD}); choose another folder"
        )
    check_settings(folder, earlier, settings)
    missing = missing_frames(folder, frames, release, len(rig))
    print_config(config)
    if len(missing) < len(frames):
        console.print(
            f"{len(frames) - len(missing)} of {len(frames)} frames are already complete in {folder}; skipping them"
        )
    world = World(
        rig,
        config.kind,
        config.scale * NATURAL_MIN_DEPTH,
        _meshes(config),
        carrier=config.carrier,
        carrier_counts=True,
        samples_per_pixel=config.samples_per_pixel,
    )
    world.check_free_space(rig)
    make = partial(numbered_frame, world, config.first_seed, config.height)
    loader: DataLoader[Any] = DataLoader(missing, None, num_workers=config.num_workers, collate_fn=make)  # type: ignore[arg-type]
    if missing:
        write_yaml(folder / RECORD, settings)
        rendered = track(loader, "rendering", total=len(missing))
        write_omnistereo(folder, rendered, rig, release, config.min_depth)
    print(f"{len(missing)} frames written, {len(frames)} in {folder}")
    print(
        f"Depth: sphericalvision-predict calibration={folder} images='{folder}/cam{{camera}}/{{frame}}.png'"
    )
    print(f"Read back with: data=omnistereo data.root={folder} data.train_split=all data.val_split=all")
    return len(missing)


def _meshes(config: RenderConfig) -> MeshFiles | None:
    return None if config.mesh is None else mesh_files(config.mesh, config.mesh_up, config.mesh_scale)


def numbered_frame(world: World, first_seed: int, height: int, number: int) -> dict[str, Any]:
    """Render the frame of a number, from 1, which is also its name."""
    return {**recorded_sample(world.frame(first_seed + number - 1), height), "frame": f"{number:05d}"}


RECORD = "rendered.yaml"
"""File next to the frames: the settings that they were rendered with."""


def settings_of(config: RenderConfig, rig: CameraRig, release: str) -> dict[str, Any]:
    """Return the settings that all frames of a folder share; meshes by name and content, up and scale included."""
    meshes = _meshes(config)
    names = ("kind", "first_seed", "scale", "samples_per_pixel", "height", "min_depth")
    return {
        **{name: getattr(config, name) for name in names},
        "carrier": config.carrier,
        "mesh": None if meshes is None else [meshes.content(path) for path in meshes.paths],
        "release": release,
        "rig": rig_fingerprint(rig, digits=6),
    }


def missing_frames(root: Path, frames: range, release: str, num_cameras: int) -> list[int]:
    """Return the frames of which ``root`` lacks a file; each appears when it is whole."""
    layout = RELEASES[release]
    names = [f"cam{number + 1}/{{:05d}}.png" for number in range(num_cameras)]
    names.append(f"{layout.ground_truth_folder}/{{:05d}}{layout.suffix}")
    return [frame for frame in frames if not all((root / name.format(frame)).is_file() for name in names)]
