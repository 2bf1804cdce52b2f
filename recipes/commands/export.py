# SPDX-License-Identifier: Apache-2.0
"""A network with the tables of a rig inside as files that run without this package: ``.pt2`` and ONNX."""

import time
from pathlib import Path
from typing import Annotated, Literal

import torch
from annotated_types import Ge
from pydantic.dataclasses import dataclass
from safetensors.torch import save_file
from torch import Tensor

from sphericalvision.capture import Predictor
from sphericalvision.capture.export import (
    OPSET,
    OUTPUTS,
    RigProgram,
    compile_program,
    export_onnx,
    export_program,
    onnx_difference,
    rig_tables,
)
from sphericalvision.capture.predictor import with_own
from sphericalvision.core import ArgumentError
from sphericalvision.io.files import atomic_write
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.recipes.app.cli import print_config, say
from sphericalvision.recipes.app.kinds import STRICT, Count, Positive, Text
from sphericalvision.recipes.app.rigs import Calibration, names_of
from sphericalvision.scenes import make_scene, render_rig


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ExportConfig:
    """Keys of ``conf/export.yaml``."""

    file: Calibration
    cameras: list[str | int] | None
    method: Literal["network", "semi_global"]
    checkpoint: Text | None
    num_hypotheses: Annotated[int, Ge(2)] | None
    level: Count | None
    min_depth: Positive | Literal["auto"]
    inputs: Literal["camera", "sphere"]
    height: Count | None
    tables: Literal["inside", "inputs"]
    batch: Count | None
    formats: list[Literal["pt2", "onnx", "compiled"]]
    device: Literal["cpu", "cuda"]
    precision: Literal["float32", "bfloat16", "float16"]
    output: Text


def export(config: ExportConfig, folder: Path) -> list[Path]:
    """Write the program in every format of ``config.formats``; returns the files."""
    if "onnx" in config.formats and config.precision != "float32":
        raise ArgumentError(
            f"precision: expected float32 for formats=[onnx], got {config.precision}: runtimes of ONNX convert "
            "files themselves; formats=[pt2,compiled] take it"
        )
    rig = config.file.rig()
    if config.cameras is not None:
        rig = rig.subset(names_of(config.cameras, rig))
    min_depth = None if config.min_depth == "auto" else config.min_depth
    predictor = Predictor(
        rig,
        with_own(read_network(config.checkpoint), False, num_hypotheses=config.num_hypotheses),
        method=config.method,
        min_depth=min_depth,
        level=config.level,
        device=config.device,
        precision=config.precision,
    )
    print_config(config, folder)
    program = RigProgram(predictor, config.inputs, config.height, config.tables).eval()
    images = rendered_images(predictor, program)
    images = images.expand(config.batch or 1, *images.shape[1:])
    with torch.inference_mode():
        answer = zip(OUTPUTS, program(images), strict=True)
    shapes = ", ".join(f"{name} {tuple(value.shape)}" for name, value in answer)
    say(f"images {tuple(images.shape)} -> {shapes}")
    written = []
    if config.tables == "inputs":
        tables = {name: table.contiguous() for name, table in rig_tables(program).items()}
        written.append(folder / "tables.safetensors")
        with atomic_write(written[-1]) as temporary:
            save_file(tables, temporary)
        say(f"tables: {len(tables)} inputs besides the images, those of this rig in {written[-1].name}")
    if config.formats:
        written += programs(program, images, config, folder)
    for file in written:
        print(file)
    return written


def programs(program: RigProgram, images: Tensor, config: ExportConfig, folder: Path) -> list[Path]:
    """Write the files of ``config.formats``; what each took, and how well it computes, is printed."""
    written = []
    start = time.process_time()

    def record(path: Path, what: str) -> None:
        written.append(path)
        size, seconds = path.stat().st_size / 1e6, time.process_time() - start
        say(f"{path.name}: {size:.1f} MB, {seconds:.0f} s of processor time, {what}")

    path = folder / "depth.pt2"
    exported = export_program(program, path if "pt2" in config.formats else None, config.batch)
    operations = sum(node.op == "call_function" for node in exported.graph.nodes)
    if "pt2" in config.formats:
        record(path, f"{operations} operations of torch")
        written.append(path.with_suffix(".json"))
    if "compiled" in config.formats:
        start = time.process_time()
        record(compile_program(exported, folder / "depth.compiled.pt2"), "g++ beside it")
    if "onnx" in config.formats:
        start = time.process_time()
        path = export_onnx(exported, folder / "depth.onnx")
        difference = onnx_difference(path, program, images)
        record(path, f"opset {OPSET}; onnxruntime differs by {difference:.1e} 1/m in inverse depth at most")
    return written


def rendered_images(predictor: Predictor, program: RigProgram) -> Tensor:
    """Images of a room, ``(1, n, 3, *size)``: at noise, where nothing fits, rounding decides."""
    rendered = render_rig(make_scene("room", seed=1), predictor.rig, samples_per_pixel=1)
    if program.inputs == "sphere":
        return predictor.inputs(rendered)[0][None]
    return torch.stack(list(rendered.values()))[None]
