# SPDX-License-Identifier: Apache-2.0
"""The models of a study: entries of its configuration, and the network of each."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Literal

from omegaconf import DictConfig
from pydantic.dataclasses import dataclass

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.models import DepthNetwork
from sphericalvision.models.weights.pretrained import DEFAULT
from sphericalvision.recipes.app.checks import hints_of, typed
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.app.kinds import STRICT, Text
from sphericalvision.recipes.evaluation.methods import Method, Scale, baselines, make_method, training_depths
from sphericalvision.recipes.study.training import Training, training_config
from sphericalvision.recipes.training.run_folder import flat_settings


@dataclass(frozen=True, kw_only=True, config=STRICT)
class StudyModel:
    """One entry of ``models`` in the config.

    Attributes:
        name: of its folders and in JSON.
        label: in tables and pictures; the name if not given.
        kind: a depth map for all frames is "constant".
        train: words of sphericalvision-train; for "constant" they choose the training set of the median.
        checkpoint: existing weights, or a sweep that needs no training, as ``make_method`` names them; ``{seed}``
            stands for each seed. With neither, a network is the one that ships.
    """

    name: Text
    label: Text | None = None
    kind: Literal["depth_network", "constant"] = "depth_network"
    train: list[str] | None = None
    checkpoint: Text | None = None

    def words(self, config: DictConfig) -> tuple[str, ...]:
        """Words of ``training``, its own, and of ``extra_training``; later ones win."""
        return (*config.training, *(self.train or ()), *config.extra_training)

    def trainings(self, config: DictConfig, folder: Path) -> list[Training]:
        """Trainings of the model, one for each seed; none where it is not trained."""
        if self.kind != "depth_network" or self.train is None or self.checkpoint is not None:
            return []
        home = folder / "models" / self.name
        runs = [(*self.words(config), f"seed={seed}") for seed in config.seeds]
        return [
            Training(self.name, seed, home / f"seed{seed}", words, training_config(words))
            for seed, words in zip(config.seeds, runs, strict=True)
        ]

    def methods(self, config: DictConfig, trainings: Sequence[Training]) -> list[Method]:
        """The method of each trained seed, or the only one of a model without seeds."""
        if self.kind == "constant":
            training = training_config(self.words(config))
            data = {key: value for key, value in flat_settings(training).items() if key.startswith("data.")}
            identity = [data, training.model.min_depth, config.baseline_frames]
            return [Method(self.name, partial(median, config, training), 0.0, identity, self.label)]
        weights: dict[int | None, str] = {None: self.checkpoint or DEFAULT}
        if any(training.model == self.name for training in trainings):
            weights = {t.seed: str(t.weights) for t in trainings if t.model == self.name and t.is_done}
        elif self.checkpoint is not None and "{seed}" in self.checkpoint:
            weights = {seed: self.checkpoint.replace("{seed}", str(seed)) for seed in config.seeds}
        return [
            Method(
                self.name if seed is None else f"{self.name}/seed{seed}",
                partial(network, word, config),
                label=self.label or self.name,
                seed=seed,
            )
            for seed, word in weights.items()
        ]


def median(config: DictConfig, training: DictConfig) -> DepthNetwork:
    """The constant map of a training, at most of ``config.baseline_frames`` frames."""
    data = build(training.data, "data")
    data.min_depth = training.model.min_depth
    depths = training_depths(data, config.model.level, config.baseline_frames)
    return baselines(scale_of(config), config.model.level, depths)[0].net


def network(word: str, config: DictConfig) -> DepthNetwork:
    """The network that a word names as for ``make_method``, at the study's level and nearest depth."""
    net = make_method(word, config.model.level, scale_of(config)).net
    return net.with_changes(level=config.model.level if net.images == "sphere" else None)


def scale_of(config: DictConfig) -> Scale:
    """The hypotheses of a study's errors."""
    return Scale(config.num_hypotheses, config.model.min_depth)


def study_models(config: DictConfig) -> list[StudyModel]:
    """The models of ``config.models``, in order, and the network of ``config.checkpoint``; null is left out."""
    models = [_model(name, node) for name, node in (config.models or {}).items() if node is not None]
    if config.checkpoint is not None:
        label = Path(config.checkpoint).stem
        models.append(StudyModel(name="own", label=label, checkpoint=config.checkpoint))
    if not models:
        raise ArgumentError("models: expected at least one model, got none; see study=small for examples")
    return models


def _model(name: str, entry: DictConfig) -> StudyModel:
    keys = tuple(key for key in hints_of(StudyModel) if key != "name")
    for key in entry:
        check_choice(f"models.{name}", key, keys)
    model = typed(StudyModel, {**entry, "name": name}, f"models.{name}.")
    if model.kind == "constant" and model.train is None:
        raise ArgumentError(
            f"models.{name}.train: a constant depth map is the median of a training set; give the words that "
            "choose it, or [] for that of the words in training"
        )
    return model
