# SPDX-License-Identifier: Apache-2.0
"""The evaluations of a study: a model, a seed and a view each, kept as JSON and never done twice."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytorch_lightning as pl
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from sphericalvision.core import check_file
from sphericalvision.io.files import atomic_write
from sphericalvision.recipes.app.cli import choose_device
from sphericalvision.recipes.study.data import View, study_frames, training_depths
from sphericalvision.recipes.study.measures import Measured, Yardstick, measure
from sphericalvision.recipes.study.models import Scale, StudyModel, constant_map, make_estimator
from sphericalvision.recipes.study.training import (
    flat_config,
    read_json,
    training_config,
    training_words,
    write_json,
)

__all__ = ["Job", "evaluate_jobs", "scale_of"]

GENERATION = 2
"""Raised whenever an evaluation would come out otherwise, so that old ones are not taken."""

NO_MATTER = ("batch_size", "rig.", "entries", "seed", "num_test", "panorama_size", "num_train", "num_val")
"""Beginnings of keys of the data that leave an evaluation as it is, or that the study sets by itself."""


class Job(NamedTuple):
    """One evaluation.

    Attributes:
        model: what is evaluated.
        seed: of its training; None for a model that has only one version.
        view: of the frames.
        weights: of a network; None for the one that ships, and for what has none.
        folder: of the study.
    """

    model: StudyModel
    seed: int | None
    view: View
    weights: Path | None
    folder: Path

    @property
    def path(self) -> Path:
        """The JSON of its errors; the estimate that is drawn lies beside it as ``.npz``."""
        version = "" if self.seed is None else f"seed{self.seed}"
        return self.folder / "evaluation" / self.model.name / version / f"{self.view.name}.json"

    def stored(self, key: dict[str, Any]) -> dict[str, Any] | None:
        """What is there already, if it was measured under the same circumstances."""
        if not self.path.is_file() or not self.path.with_suffix(".npz").is_file():
            return None
        try:
            result = read_json(self.path)
            self.drawn()
        except Exception:  # damaged, so it is measured again; numpy raises nearly anything
            return None
        return result if result.get("key") == json.loads(json.dumps(key)) else None

    def drawn(self) -> Tensor:
        """The estimate ``(V,)`` of the frame that is drawn."""
        with np.load(self.path.with_suffix(".npz")) as stored:
            return torch.from_numpy(stored["index"])

    def store(self, key: dict[str, Any], scale: Scale, measured: Measured) -> dict[str, Any]:
        """Write what was measured and return it."""
        result = {
            "key": key,
            "model": self.model.name,
            "label": self.model.label,
            "seed": self.seed,
            **self.view._asdict(),
            **scale._asdict(),
            "num_frames": len(measured.frames["names"]),
            "errors": measured.errors,
            "frames": measured.frames,
        }
        with atomic_write(self.path.with_suffix(".npz")) as temporary:
            np.savez_compressed(temporary, index=measured.drawn.numpy())
        write_json(self.path, result)
        return result


def scale_of(config: DictConfig) -> Scale:
    """Level, hypotheses and nearest depth of a study."""
    return Scale(config.model.level, config.num_hypotheses, config.model.min_depth)


def evaluate_jobs(config: DictConfig, jobs: list[Job]) -> list[dict[str, Any]]:
    """Results of jobs of one view; those that are not there are measured in one pass over the frames."""
    keys = [_key(config, job) for job in jobs]
    results = [job.stored(key) for job, key in zip(jobs, keys, strict=True)]
    missing = [number for number, result in enumerate(results) if result is None]
    if missing:
        pl.seed_everything(config.seed, verbose=False)
        device, scale, view = choose_device(config.device), scale_of(config), jobs[0].view
        estimators = {
            str(n): make_estimator(
                jobs[n].model, scale, jobs[n].weights, _constant(config, jobs[n], scale), device
            )
            for n in missing
        }
        data, frames = study_frames(config, view)
        yardstick = Yardstick(scale, device)
        measured = measure(estimators, data.loader(frames), yardstick, config.panel_frame, view.name)
        for n in missing:
            results[n] = jobs[n].store(keys[n], scale, measured[str(n)])
    return [result for result in results if result is not None]


def _constant(config: DictConfig, job: Job, scale: Scale) -> Tensor | None:
    if job.model.kind != "constant":
        return None
    training = training_config(training_words(job.model, config))
    return constant_map(*training_depths(training, scale.level, config.baseline_frames), scale)


def _key(config: DictConfig, job: Job) -> dict[str, Any]:
    """What an evaluation depends on; compared with that of a stored one."""
    data: dict[str, Any] = OmegaConf.to_container(config.data, resolve=True)  # type: ignore[assignment]
    flat = flat_config(OmegaConf.create({"data": data}))
    key = {k: v for k, v in flat.items() if not k.removeprefix("data.").startswith(NO_MATTER)}
    key |= {"generation": GENERATION, "kind": job.model.kind, "options": job.model.sweep_options}
    names = ("frames", "image_size", "panel_frame", "num_hypotheses", "model")
    key |= {name: _plain(config[name]) for name in names}
    if "rig" in config.data:
        fisheye = job.view.inputs == "fisheye"
        key["rig"] = _plain(config.rig if fisheye else config.equirect_rig)
        key["equirect_size"] = None if fisheye else _plain(config.equirect_size)
    if job.model.kind == "constant":
        training = training_config(training_words(job.model, config))
        key["training_data"] = flat_config(training.data)
        key["baseline_frames"] = config.baseline_frames
    if job.model.kind == "depth_network":
        key["weights"] = "shipped" if job.weights is None else _digest(job.weights)
    return key


def _plain(node: Any) -> Any:
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def _digest(path: Path) -> str:
    """Of a file's content."""
    return hashlib.sha256(check_file(path, "weights").read_bytes()).hexdigest()[:16]
