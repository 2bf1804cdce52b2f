# SPDX-License-Identifier: Apache-2.0
"""Render a data set in the layout of OmniThings: ``sphericalvision-render output=... num_frames=...``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.progress import track
from torch.utils.data import DataLoader

from sphericalvision.cameras import CameraRig, EquirectangularCamera
from sphericalvision.data import write_omnistereo
from sphericalvision.io.files import write_yaml
from sphericalvision.recipes.app.cli import build, console, print_config
from sphericalvision.recipes.app.rendered_sets import RECORD, check_settings, missing_frames, settings_of
from sphericalvision.scenes.meshes import MeshFiles, mesh_files
from sphericalvision.scenes.rendered_frames import RenderedFrames

__all__ = ["render"]


def render(config: DictConfig) -> int:
    """Render the frames that ``config.output`` lacks, which the runs of a multi-run share; returns how many these were.

    Raises:
        ArgumentError: the folder holds frames of other settings.
    """
    folder = Path(config.output).absolute()
    rig: CameraRig = build(config.rig, "rig")
    panoramas = any(isinstance(camera, EquirectangularCamera) for camera in rig.cameras.values())
    release = config.release or ("tiff" if panoramas else "png")
    frames = range(config.first_frame, config.first_frame + config.num_frames)
    settings = settings_of(config, rig, release)
    check_settings(folder, settings, release)
    missing = missing_frames(folder, frames, release, len(rig))
    print_config(config)
    if len(missing) < len(frames):
        console.print(
            f"{folder} holds {len(frames) - len(missing)} of the {len(frames)} frames already; they are kept."
        )
    rendered = RenderedFrames(
        rig,
        missing,
        first_seed=config.first_seed,
        kind=config.kind,
        samples_per_pixel=config.samples_per_pixel,
        height=config.height,
        scale=config.scale,
        meshes=_meshes(config),
        carrier=config.carrier,
    )
    if missing:
        write_yaml(folder / RECORD, settings)
        write_omnistereo(folder, _progress(rendered, config.num_workers), rig, release, config.min_depth)
    print(f"{len(missing)} frames written, {len(frames)} in {folder}")
    print(f"Read back with: data=omnistereo data.root={folder} data.train_split=all data.val_split=all")
    return len(missing)


def _meshes(config: DictConfig) -> MeshFiles | None:
    if config.mesh is None:
        return None
    given: Any = config.mesh if isinstance(config.mesh, str) else list(config.mesh)
    return mesh_files(given, config.mesh_up, config.mesh_scale)


def _progress(frames: RenderedFrames, num_workers: int) -> Iterator[dict[str, Any]]:
    loader = DataLoader(frames, batch_size=None, num_workers=num_workers)
    yield from track(loader, "rendering", total=len(frames), console=console)
