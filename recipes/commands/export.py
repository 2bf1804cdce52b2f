# SPDX-License-Identifier: Apache-2.0
"""A network with the tables of a rig inside as files that run without this package: ``.pt2`` and ONNX."""

from __future__ import annotations

import time
from pathlib import Path

import torch
from omegaconf import DictConfig

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.deploy import Predictor
from sphericalvision.deploy.export import (
    INPUTS,
    OPSET,
    RigProgram,
    example_images,
    export_onnx,
    export_program,
    onnx_difference,
)
from sphericalvision.recipes.app.cli import console, print_config
from sphericalvision.recipes.app.rigs import rig_from_file

__all__ = ["export"]

FORMATS = ("pt2", "onnx")


def export(config: DictConfig, folder: Path) -> list[Path]:
    """Write the program in every format of ``config.formats``; returns the files.

    Raises:
        ArgumentError: an unknown format or input, or what ``RigProgram`` refuses.
    """
    check_choice("inputs", config.inputs, INPUTS)
    for name in config.formats:
        check_choice("formats", name, FORMATS)
    if isinstance(config.min_depth, str) and config.min_depth != "auto":
        raise ArgumentError(f"min_depth: expected a number of metres or auto, got {config.min_depth!r}")
    rig = rig_from_file(config.calibration, config.translation_unit, config.max_angle_deg)
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
    program = RigProgram(predictor, config.inputs, config.height).eval()
    images = example_images(program, config.batch)
    start = time.process_time()
    with torch.inference_mode():
        answer = program(images)
    shapes = ", ".join(f"{name} {tuple(v.shape)}" for name, v in zip(NAMES, answer, strict=True))
    console.print(f"images {tuple(images.shape)} -> {shapes}", highlight=False, soft_wrap=True)
    written = []
    path = folder / "depth.pt2"
    exported = export_program(program, path if "pt2" in config.formats else None, config.batch)
    if "pt2" in config.formats:
        written.append(path)
    console.print(f"torch.export: {time.process_time() - start:.0f} s of processor time", highlight=False)
    if "onnx" in config.formats:
        written.append(export_onnx(exported, folder / "depth.onnx"))
        difference = onnx_difference(written[-1], program, images)
        console.print(
            f"ONNX, opset {OPSET}: {time.process_time() - start:.0f} s of processor time; onnxruntime differs by "
            f"{difference:.1e} 1/m in inverse depth at most",
            highlight=False,
            soft_wrap=True,
        )
    for file in written:
        print(file)
    return written


NAMES = ("inverse_depth", "confidence", "seen")
