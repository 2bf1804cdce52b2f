# SPDX-License-Identifier: Apache-2.0
"""The types of the commands' own keys; units and meanings stand in the YAML files of the same names.

A key has one type whatever the command; ``OWN`` are the exceptions.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal

from annotated_types import Ge, MinLen
from omegaconf import DictConfig, OmegaConf
from pydantic import Field

from sphericalvision.recipes.app.checks import fault
from sphericalvision.recipes.app.kinds import (
    Count,
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

__all__ = ["type_of", "unused_key", "wrong_key"]

KEYS: dict[str, Any] = {
    # what is read
    "calibration": Text,
    "images": Text,
    "frames": Annotated[list[int | str], MinLen(1)] | None,
    "frame": int | str | None,
    "start": Number,
    "stop": Count | None,
    "every": Count,
    "cameras": Names | None,
    "camera": Text | int | None,
    "masks": Text | None,
    "poses": Text | None,
    "translation_unit": Unit | None,
    "max_angle_deg": HalfAngle | None,
    "runs": Text,
    # networks
    "method": Literal["network", "semi_global"],
    "checkpoint": Text | None,
    "level": Count | None,
    "num_hypotheses": Annotated[int, Ge(2)] | None,
    "min_depth": Positive | Literal["auto", "scene"],
    "trained_radius": Positive,
    "device": Annotated[
        str, Field(pattern=r"^(auto|(cpu|cuda|mps|xpu)(:\d+)?)$", description="auto, cpu or cuda")
    ],
    "seed": Number,
    "resume": Text | None,
    "init_weights": Text | None,
    "tags": list[str | int],
    # captures
    "photometric": bool,
    "align": bool,
    "window": Annotated[int, Ge(2)],
    "spacing": Positive | None,
    "up": Literal["-y", "y", "z", "camera"],
    "skip_existing": bool,
    "on_error": Literal["skip", "stop"],
    "check": bool,
    "depths": Annotated[list[Distance], MinLen(1)],
    "picture_depths": list[Distance],
    # what is written
    "output": Text,
    "outputs": list[str] | None,
    "height": Count,
    "near": Positive | None,
    "min_confidence": Share,
    "voxel": Positive | None,
    "batch": Count | None,
    # cameras
    "to": Text | None,
    "format": Text | None,
    "num_coefficients": Count | None,
    "projection": Text | None,
    "fit_angle_deg": HalfAngle | None,
    "board": Text,
    "square": Positive | None,
    "marker": Positive | None,
    "dictionary": Text,
    "field_of_view_deg": FullAngle,
    # scenes
    "num_frames": Count,
    "first_frame": Number,
    "first_seed": Number,
    "scene_seed": Number,
    "train_seed": Number,
    "baseline_scenes": Count,
    "kind": Text,
    "mesh": Text | list[str] | None,
    "mesh_up": Literal["y", "z"],
    "mesh_scale": Positive,
    "carrier": Text | None,
    "release": Literal["png", "tiff"] | None,
    "scale": Positive,
    "samples_per_pixel": Count,
    "num_workers": Number,
    "batch_size": Count,
    # evaluation and study
    "split": Literal["train", "val", "test"],
    "baselines": bool,
    "angles_deg": Annotated[list[float], MinLen(1)],
    "seeds": Annotated[list[Number], MinLen(1)],
    "equirect_size": Size | None,
    "panorama_size": Size,
    "baseline_frames": Count,
    "panel_frame": Number,
    "panel_height": Count,
    "train": bool,
    "on_change": Literal["refuse", "redo"],
    "methods": list[str],
    "tracks": list[str],
    "meshes": list[str],
    "panorama_rows": Annotated[int, Ge(2)],
    "image_rows": Annotated[int, Ge(8)],
    "cache_dir": Text | None,
    "workers": Number,
    # speed
    "groups": Annotated[list[str], MinLen(1)],
    "only": Text | None,
    "seconds": Positive,
    "threads": Count | None,
    "settings": list[Size],
    "feature_channels": Count,
    "image_size": Size | None,
    "memory": bool,
    "options": list[str],
    "variants": list[str],
    "convolution_settings": list[Size],
    "num_points": Count,
    "image_sides": Annotated[list[Count], MinLen(1)],
    "presets": Annotated[list[Literal["default", "live", "fast", "fine"]], MinLen(1)],
}
"""Key -> its type."""

TRAINER: dict[str, Any] = {
    "max_steps": Annotated[int, Ge(-1)],
    "max_time": Annotated[
        str, Field(pattern=r"^\d+:\d\d:\d\d:\d\d$", description="days to seconds as 00:12:00:00")
    ]
    | dict[str, Any]
    | None,
    "val_check_interval": Count,
    "check_val_every_n_epoch": type(None),
    "limit_val_batches": Count | Share | None,
    "num_sanity_val_steps": Annotated[int, Ge(-1)],
    "accelerator": Literal["auto", "cpu", "gpu", "cuda", "mps", "tpu"],
    "devices": Literal["auto", -1]
    | Count
    | Annotated[str, Field(pattern=r"^\d+(,\d+)*$", description="numbers of GPUs as 0,2")]
    | Annotated[list[Number], MinLen(1)],
    "num_nodes": Count,
    "use_distributed_sampler": Literal[False],
    "accumulate_grad_batches": Count,
    "gradient_clip_val": Annotated[float, Ge(0)] | None,
    "overfit_batches": Number | Share,
    "log_every_n_steps": Number,
    "profiler": Literal["simple", "advanced", "pytorch"] | dict[str, Any] | None,
}
"""Keys of the group ``trainer`` that Lightning's own hints leave more open; the others are compared with those."""

OWN: dict[str, dict[str, Any]] = {
    "export": {
        "height": Count | None,
        "cameras": list[str | int] | None,
        "min_depth": Positive | Literal["auto"],
        "inputs": Literal["camera", "sphere"],
        "tables": Literal["inside", "inputs"],
        "formats": list[Literal["pt2", "onnx", "compiled"]],
    },
    "inspect": {"images": Text | None, "level": Number},
    "convert": {"output": Text | None},
    "calibrate": {"to": Text},
    "render": {"min_depth": Positive},
    "evaluate": {"masks": Literal["auto"] | None},
    "study": {
        "inputs": Literal["fisheye", "equirect"],
        "num_hypotheses": Annotated[int, Ge(2)],
        "frames": Count | None,
        "training": list[str],
    },
    "speed": {"training": bool, "image_size": Size},
}
"""Command -> its keys of another type."""

GROUPS: dict[str, dict[str, Any]] = {
    "trainer": TRAINER,
    "data": {"num_workers": Number, "batch_size": Count, "seed": Number},
    "benchmark": {**KEYS, "frames": Count, "level": Annotated[int, Ge(3)]},
}
"""Group -> the types of keys that all its options have; what else they have is compared where it is made."""


ONLY_WITH: dict[str, dict[str, tuple[str, ...]]] = {
    "predict": {
        "poses": ("window", "spacing", "up"),
        "min_depth=auto": ("trained_radius",),
        "outputs=[cloud]|[glb]|[fused]": ("min_confidence", "voxel"),
    },
    "inspect": {"images": ("frame",)},
    "convert": {"to": ("num_coefficients", "projection", "fit_angle_deg"), "output": ("format",)},
    "render": {"mesh": ("mesh_up", "mesh_scale")},
    "calibrate": {"to=fisheye": ("projection",), "marker": ("dictionary",)},
    "train": {"data.rig": ("rig",), "data.mesh": ("data.mesh_up", "data.mesh_scale")},
    "evaluate": {"data.rig": ("rig",), "data.mesh": ("data.mesh_up", "data.mesh_scale")},
    "study": {"data.rig": ("rig",), "inputs=equirect": ("equirect_rig", "equirect_size")},
}
"""Command -> a key that has a value, or one that has (in a list: holds) one of these -> keys that count only then."""


def type_of(command: str, key: str) -> Any:
    """The type hint of a command's own key; None where it has none."""
    return OWN.get(command, {}).get(key, KEYS.get(key))


def wrong_key(command: str, config: DictConfig) -> str | None:
    """What is wrong with the first key of a command, or of its groups, that does not fit its type; None if all do."""
    keys = {str(key): (type_of(command, str(key)), config, key) for key in config}
    for group, types in GROUPS.items():
        keys |= {f"{group}.{key}": (types.get(key), config[group], key) for key in config.get(group) or ()}
    key: Any
    for name, (hint, node, key) in keys.items():
        if hint is None or OmegaConf.is_missing(node, key) or OmegaConf.is_interpolation(node, key):
            continue
        value = node[key]
        if wrong := fault(name, OmegaConf.to_container(value) if OmegaConf.is_config(value) else value, hint):
            return wrong
    return None


def unused_key(command: str, config: DictConfig, given: Iterable[str]) -> str | None:
    """What is wrong with the first key that is ``given``, but that this command does not look at; None if all count."""
    for needed, keys in ONLY_WITH.get(command, {}).items():
        key, equal, wanted = needed.partition("=")
        value = OmegaConf.select(config, key)
        values = [f"[{one}]" for one in value] if OmegaConf.is_list(value) else [str(value)]
        counts = bool({*values} & {*wanted.split("|")}) if equal else value is not None
        if counts or (key == "outputs" and value is None):  # null are the usual ones, clouds among them
            continue
        if lost := [name for name in given if f"{name}.".startswith(tuple(f"{part}." for part in keys))]:
            word = "data=scenes" if key == "data.rig" else needed if equal else f"{needed}=..."
            return f"{lost[0]}: counts only with {word.replace('|', f' or {key}=')}; give that, too, or leave it out"
    return None
