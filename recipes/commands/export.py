# SPDX-License-Identifier: Apache-2.0
"""A network with the tables of a rig inside as files that run without this package: ``.pt2`` and ONNX."""

from __future__ import annotations

import time
from pathlib import Path

import torch
from omegaconf import DictConfig
from safetensors.torch import save_file
from torch import Tensor

from sphericalvision.capture import Predictor
from sphericalvision.capture.export import (
    OPSET,
    RigProgram,
    compile_program,
    export_onnx,
    export_program,
    onnx_difference,
    rig_tables,
)
from sphericalvision.io.files import atomic_write
from sphericalvision.recipes.app.cli import print_config, say
from sphericalvision.recipes.app.rigs import rig_from_file
from sphericalvision.scenes import make_scene, render_rig

__all__ = ["export"]


def export(config: DictConfig, folder: Path) -> list[Path]:
    """Write the program in every format of ``config.formats``; returns the files.

    Raises:
        ArgumentError: what ``RigProgram`` refuses.
    """
    rig = rig_from_file(config.calibration, config.translation_unit, config.max_angle_deg, config.image_size)
    if config.cameras is not None:
        rig = rig.subset(list(config.cameras))
    min_depth = None if config.min_depth == "auto" else config.min_depth
    predictor = Predictor(
        rig,
        config.checkpoint,
        method=config.method,
        min_depth=min_depth,
        level=config.level,
        num_hypotheses=config.num_hypotheses,
    )
    print_config(config, folder)
    program = RigProgram(predictor, config.inputs, config.height, config.tables).eval()
    images = rendered_images(predictor, program).expand(
        config.batch or 1, *[-1] * (4 if config.inputs == "camera" else 3)
    )
    say(f"images {tuple(images.shape)} -> {answer_shapes(program, images)}")
    written = []
    if config.tables == "inputs":
        written.append(save_tables(program, folder / "tables.safetensors"))
        say(
            f"tables: {len(rig_tables(program))} inputs besides the images, those of this rig in {written[-1].name}"
        )
    if not config.formats:
        return shown(written)
    start = time.process_time()
    path = folder / "depth.pt2"
    exported = export_program(program, path if "pt2" in config.formats else None, config.batch)
    operations = sum(node.op == "call_function" for node in exported.graph.nodes)
    say(f"torch.export: {operations} operations, {time.process_time() - start:.0f} s of processor time")
    if "pt2" in config.formats:
        written += [path, path.with_suffix(".json")]
        say(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB")
    if "compiled" in config.formats:
        start = time.process_time()
        written.append(compile_program(exported, folder / "depth.compiled.pt2"))
        seconds = time.process_time() - start
        say(
            f"{written[-1].name}: {written[-1].stat().st_size / 1e6:.1f} MB, {seconds:.0f} s of processor time and g++"
        )
    if "onnx" in config.formats:
        start = time.process_time()
        written.append(export_onnx(exported, folder / "depth.onnx"))
        size = written[-1].stat().st_size
        seconds = time.process_time() - start
        difference = onnx_difference(written[-1], program, images)
        say(
            f"{written[-1].name}: opset {OPSET}, {size / 1e6:.1f} MB, "
            f"{seconds:.0f} s of processor time; onnxruntime differs by {difference:.1e} 1/m in inverse depth at most"
        )
    return shown(written)


def rendered_images(predictor: Predictor, program: RigProgram) -> Tensor:
    """Images of a room, ``(1, n, 3, *size)``: at noise, where nothing fits, rounding decides."""
    rendered = render_rig(make_scene("room", seed=1), predictor.rig, samples_per_pixel=1)
    if program.inputs == "sphere":
        return predictor.inputs(rendered)[0][None]
    return torch.stack(list(rendered.values()))[None]


def answer_shapes(program: RigProgram, images: Tensor) -> str:
    """Names and shapes of the outputs."""
    with torch.inference_mode():
        answer = program(images)
    return ", ".join(f"{name} {tuple(value.shape)}" for name, value in zip(NAMES, answer, strict=True))


def save_tables(program: RigProgram, path: Path) -> Path:
    """Write the inputs that are not images."""
    with atomic_write(path) as temporary:
        save_file({name: table.contiguous() for name, table in rig_tables(program).items()}, temporary)
    return path


def shown(written: list[Path]) -> list[Path]:
    """Print the paths of files, which are the result."""
    for file in written:
        print(file)
    return written


NAMES = ("inverse_depth", "confidence", "seen")
