# SPDX-License-Identifier: Apache-2.0
"""The types of the commands' own keys; units and meanings stand in the YAML files of the same names."""

from __future__ import annotations

from typing import Annotated, Literal

from sphericalvision.recipes.app.kinds import (
    Count,
    Device,
    Distance,
    FullAngle,
    HalfAngle,
    Names,
    Number,
    Positive,
    Share,
    Size,
    Text,
    Unit,
)
from sphericalvision.recipes.app.schema import AtLeast, Like, NotEmpty

__all__ = ["GROUPS", "KEYS"]


class Prepared:
    """The group ``preparation``."""

    photometric: bool
    align: bool


class Predict(Prepared):
    """``sphericalvision-predict``."""

    calibration: Text
    images: Text
    frames: Annotated[list[int | str], NotEmpty()] | None
    start: Number
    stop: Count | None
    every: Count
    cameras: Names | None
    masks: Text | None
    translation_unit: Unit | None
    max_angle_deg: HalfAngle | None
    poses: Text | None
    window: Annotated[int, AtLeast(2)]
    spacing: Positive | None
    up: Literal["-y", "y", "z", "camera"]
    method: Literal["network", "semi_global"]
    checkpoint: Text | None
    level: Count | None
    num_hypotheses: Annotated[int, AtLeast(2)] | None
    min_depth: Positive | Literal["auto", "scene"]
    trained_radius: Positive
    antialias: bool
    outputs: list[str] | None
    height: Count
    near: Positive | None
    min_confidence: Share
    voxel: Positive | None
    output: Text
    skip_existing: bool
    on_error: Literal["skip", "stop"]
    device: Device


class Export:
    """``sphericalvision-export``."""

    calibration: str
    cameras: list[str | int] | None
    translation_unit: str | None
    max_angle_deg: Positive | None
    method: str
    checkpoint: str | None
    num_hypotheses: Annotated[int, AtLeast(2)] | None
    level: Count | None
    min_depth: Positive | str
    inputs: str
    height: Count | None
    tables: str
    batch: Count | None
    formats: list[str]
    output: str


class Inspect:
    """``sphericalvision-inspect``."""

    calibration: Text
    images: Text | None
    frame: int | str | None
    cameras: Names | None
    masks: Text | None
    depths: Annotated[list[Distance], NotEmpty()]
    picture_depths: list[Distance]
    level: Number
    max_angle_deg: HalfAngle | None
    translation_unit: Unit | None
    output: Text


class Convert:
    """``sphericalvision-convert``."""

    calibration: Text
    to: Text | None
    output: Text | None
    format: Text | None
    camera: Text | int | None
    num_coefficients: Count | None
    projection: Text | None
    fit_angle_deg: HalfAngle | None
    max_angle_deg: HalfAngle | None
    translation_unit: Unit | None


class Calibrate:
    """``sphericalvision-calibrate``."""

    images: Text
    board: Text
    square: Positive
    to: Text
    field_of_view_deg: FullAngle
    num_coefficients: Count | None
    projection: Text | None
    output: Text
    format: Text | None


class Align:
    """``sphericalvision-align``."""

    calibration: Text
    images: Text
    frames: list[int | str] | None
    start: Number
    stop: Count | None
    every: Count
    num_frames: Count
    cameras: Names | None
    masks: Text | None
    translation_unit: Unit | None
    max_angle_deg: HalfAngle | None
    expected_deg: HalfAngle
    output: Text
    format: Text | None


class Render:
    """``sphericalvision-render``."""

    output: Text
    num_frames: Count
    first_frame: Number
    first_seed: Annotated[int, AtLeast(0)]
    kind: Text
    mesh: Text | list[str] | None
    mesh_up: Literal["y", "z"]
    mesh_scale: Positive
    carrier: Text | None
    release: Literal["png", "tiff"] | None
    min_depth: Positive
    scale: Positive
    samples_per_pixel: Count
    height: Count
    num_workers: Number


class Demo:
    """``python -m sphericalvision.recipes.demo``."""

    output: Text
    kind: Text
    scene_seed: Number
    samples_per_pixel: Count
    height: Count
    baseline_scenes: Count
    train_seed: Number
    checkpoint: Text | None
    device: Device


class Evaluate(Prepared):
    """``sphericalvision-evaluate``."""

    output: Text
    checkpoint: Text | None
    split: Literal["train", "val", "test"]
    baselines: bool
    masks: Literal["auto"] | None
    min_confidence: Share
    device: Device
    seed: Number


class Train:
    """``sphericalvision-train``."""

    output: Text
    tags: list[str | int]
    seed: Number
    resume: Text | None
    init_weights: Text | None


class Study:
    """``sphericalvision-study``."""

    output: Text
    angles_deg: Annotated[list[float], NotEmpty()]
    seeds: Annotated[list[Number], NotEmpty()]
    inputs: Literal["fisheye", "equirect"]
    num_hypotheses: Annotated[int, AtLeast(2)]
    frames: Count | None
    image_size: Size | None
    equirect_size: Size | None
    panorama_size: Size
    baseline_frames: Count
    training: list[str]
    panel_frame: Number
    panel_height: Count
    train: bool
    on_change: Literal["refuse", "redo"]
    device: Device
    seed: Number


class Benchmark:
    """``sphericalvision-benchmark``."""

    output: Text
    groups: Annotated[list[str], NotEmpty()]
    only: Text | None
    seconds: Positive
    threads: Count | None
    device: Device
    peak_size: Count
    settings: list[Size]
    feature_channels: Count
    image_size: Size
    training: bool
    memory: bool
    options: list[str]
    variants: list[str]
    convolution_settings: list[Size]
    num_frames: Count
    num_points: Count


class Trainer:
    """The group ``trainer``: what Lightning would refuse in its own words."""

    max_steps: Annotated[int, AtLeast(-1)]
    max_time: Annotated[str, Like(r"\d+:\d\d:\d\d:\d\d", "days to seconds as 00:12:00:00")] | dict | None  # type: ignore[type-arg]
    val_check_interval: Count
    check_val_every_n_epoch: None
    limit_val_batches: Count | Share | None
    num_sanity_val_steps: Annotated[int, AtLeast(-1)]
    accelerator: Literal["auto", "cpu", "gpu", "cuda", "mps", "tpu"]
    devices: (
        Literal["auto", -1]
        | Count
        | Annotated[str, Like(r"\d+(,\d+)*", "numbers of GPUs as 0,2")]
        | Annotated[list[Number], NotEmpty()]
    )
    num_nodes: Count
    strategy: Text
    precision: Literal[
        "32-true",
        "16-mixed",
        "bf16-mixed",
        "64-true",
        "16-true",
        "bf16-true",
        "transformer-engine",
        "bf16",
        64,
        32,
        16,
    ]
    use_distributed_sampler: Literal[False]
    sync_batchnorm: bool
    accumulate_grad_batches: Count
    gradient_clip_val: Annotated[float, AtLeast(0)] | None
    overfit_batches: Number | Share
    log_every_n_steps: Number
    profiler: Literal["simple", "advanced", "pytorch"] | dict | None  # type: ignore[type-arg]
    detect_anomaly: bool
    enable_model_summary: bool


class Data:
    """What all data modules have."""

    num_workers: Number
    batch_size: Count
    seed: Number


class BenchmarkOfMethods(Prepared):
    """The node ``benchmark`` of ``sphericalvision-study preset=benchmark``."""

    methods: list[str]
    tracks: list[str]
    frames: Count
    first_frame: Number
    meshes: list[str]
    level: Annotated[int, AtLeast(3)]
    panorama_rows: Annotated[int, AtLeast(2)]
    image_rows: Annotated[int, AtLeast(8)]
    samples_per_pixel: Count
    cache_dir: str | None
    workers: Number


KEYS: dict[str, type] = {
    "predict": Predict,
    "export": Export,
    "inspect": Inspect,
    "convert": Convert,
    "calibrate": Calibrate,
    "align": Align,
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
