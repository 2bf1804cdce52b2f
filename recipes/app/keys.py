# SPDX-License-Identifier: Apache-2.0
"""The types of the commands' own keys; units and meanings stand in the YAML files of the same names."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from sphericalvision.recipes.app.schema import AtLeast

__all__ = ["GROUPS", "KEYS"]

Positive = Annotated[float, AtLeast(0, above=True)]
Count = Annotated[int, AtLeast(1)]
Number = Annotated[int, AtLeast(0)]
Depths = list[Positive]


class Predict:
    """``sphericalvision-predict``."""

    calibration: str
    images: str
    frames: list[int | str] | None
    start: Number
    stop: Count | None
    every: Count
    cameras: list[str | int] | None
    masks: str | None
    translation_unit: str | None
    max_angle_deg: Positive | None
    method: str
    checkpoint: str | None
    level: Count | None
    num_hypotheses: Annotated[int, AtLeast(2)] | None
    min_depth: Positive | str
    trained_radius: Positive
    antialias: bool
    outputs: list[str] | None
    height: Count
    min_confidence: Annotated[float, AtLeast(0)]
    voxel: Positive | None
    output: str
    skip_existing: bool
    on_error: str
    device: str
    native: bool


class Inspect:
    """``sphericalvision-inspect``."""

    calibration: str
    images: str | None
    frame: int | str | None
    cameras: list[str | int] | None
    masks: str | None
    depths: Depths
    picture_depths: Depths
    level: Number
    max_angle_deg: Positive | None
    translation_unit: str | None
    output: str


class Convert:
    """``sphericalvision-convert``."""

    calibration: str
    to: str | None
    output: str | None
    format: str | None
    camera: str | int | None
    num_coefficients: Count | None
    projection: str | None
    fit_angle_deg: Positive | None
    max_angle_deg: Positive | None
    translation_unit: str | None


class Calibrate:
    """``sphericalvision-calibrate``."""

    images: str
    board: str
    square: Positive
    to: str
    field_of_view_deg: Positive
    num_coefficients: Count | None
    projection: str | None
    output: str
    format: str | None


class Render:
    """``sphericalvision-render``."""

    output: str
    num_frames: int
    first_frame: Number
    first_seed: Annotated[int, AtLeast(0)]
    kind: str
    mesh: str | list[str] | None
    mesh_up: str
    mesh_scale: Positive
    carrier: str | None
    release: str | None
    min_depth: Positive
    scale: Positive
    samples_per_pixel: Count
    height: Count
    num_workers: Number


class Demo:
    """``python -m sphericalvision.recipes.demo``."""

    output: str
    kind: str
    scene_seed: Number
    samples_per_pixel: Count
    height: Count
    baseline_scenes: Count
    train_seed: Number
    checkpoint: str | None
    device: str


class Evaluate:
    """``sphericalvision-evaluate``."""

    output: str
    checkpoint: str | None
    split: str
    baselines: bool
    device: str
    native: bool
    seed: Number


class Train:
    """``sphericalvision-train``."""

    output: str
    tags: list[str | int]
    seed: Number
    resume: str | None
    init_weights: str | None


class Study:
    """``sphericalvision-study``."""

    output: str
    angles_deg: list[float]
    seeds: list[Number]
    inputs: str
    num_hypotheses: Annotated[int, AtLeast(2)]
    frames: Count | None
    image_size: list[Count] | None
    equirect_size: list[Count] | None
    panorama_size: list[Count]
    baseline_frames: Count
    training: list[str]
    panel_frame: Number
    panel_height: Count
    train: bool
    on_change: str
    device: str
    seed: Number


class Benchmark:
    """``sphericalvision-benchmark``."""

    output: str
    groups: list[str]
    only: str | None
    seconds: Positive
    threads: Count | None
    device: str
    peak_size: Count
    settings: list[list[Count]]
    feature_channels: Count
    image_size: list[Count]
    training: bool
    memory: bool
    options: list[str]
    variants: list[str]
    convolution_settings: list[list[Count]]
    num_frames: Count
    num_points: Count


class Trainer:
    """The group ``trainer``: what Lightning would refuse in its own words."""

    max_steps: Annotated[int, AtLeast(-1)]
    max_time: str | dict[str, Any] | None
    val_check_interval: Annotated[float, AtLeast(0, above=True)] | None
    limit_val_batches: Annotated[float, AtLeast(0)] | None
    num_sanity_val_steps: Annotated[int, AtLeast(-1)]
    accelerator: str
    devices: Annotated[int, AtLeast(-1)] | str | list[int]
    num_nodes: Count
    strategy: str
    precision: str | int
    use_distributed_sampler: Literal[False]
    sync_batchnorm: bool
    accumulate_grad_batches: Count
    gradient_clip_val: Annotated[float, AtLeast(0)] | None
    overfit_batches: Annotated[float, AtLeast(0)]
    log_every_n_steps: Number
    detect_anomaly: bool
    enable_model_summary: bool


class Data:
    """What all data modules have."""

    num_workers: Number
    batch_size: Count
    seed: Number


class BenchmarkOfMethods:
    """The node ``benchmark`` of ``sphericalvision-study preset=benchmark``."""

    methods: list[str]
    tracks: list[str]
    frames: Count
    meshes: list[str]
    level: Annotated[int, AtLeast(3)]
    panorama_rows: Annotated[int, AtLeast(2)]
    image_rows: Annotated[int, AtLeast(8)]
    samples_per_pixel: Count
    cache_dir: str | None
    workers: Number


KEYS: dict[str, type] = {
    "predict": Predict,
    "inspect": Inspect,
    "convert": Convert,
    "calibrate": Calibrate,
    "render": Render,
    "demo": Demo,
    "evaluate": Evaluate,
    "train": Train,
    "study": Study,
    "benchmark": Benchmark,
}
"""Command -> the types of its keys."""

GROUPS: dict[str, type] = {"trainer": Trainer, "data": Data, "benchmark": BenchmarkOfMethods}
"""Group -> the types of keys that all its options have."""
