# SPDX-License-Identifier: Apache-2.0
"""The models of a study: what the configuration says of them, and the network that each is."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.models import ConstantDepth, DepthNetwork
from sphericalvision.recipes.app.cli import choose_device
from sphericalvision.recipes.evaluation.methods import Method, Scale, make_method
from sphericalvision.recipes.study.tilted_views import training_depths
from sphericalvision.recipes.study.training import CHANGES_NOTHING, Training, training_config, training_words
from sphericalvision.recipes.training.run_folder import flat_settings

__all__ = ["KINDS", "StudyModel", "methods_of", "scale_of", "study_models"]

DEFAULT = "refinedsweepnet"
"""The network that ships."""

KINDS = ("depth_network", "constant")


class StudyModel(NamedTuple):
    """One entry of ``models`` in the config.

    Attributes:
        name: of its folders and in JSON.
        label: in tables and pictures.
        kind: "depth_network", or "constant" (a depth map for all frames).
        train: words of sphericalvision-train; for "constant" they say whose median it is.
        checkpoint: weights that are there already, or a sweep that needs no training, as ``make_method`` names them;
            ``{seed}`` stands for each seed. With neither, a network is the one that ships.
    """

    name: str
    label: str
    kind: str
    train: tuple[str, ...] | None
    checkpoint: str | None

    @property
    def is_trained(self) -> bool:
        """Whether the study trains it, once a seed."""
        return self.kind == "depth_network" and self.train is not None and self.checkpoint is None


def methods_of(model: StudyModel, config: DictConfig, trainings: Sequence[Training]) -> list[Method]:
    """The method of each seed of a model, but for seeds that are not trained; of a model without seeds the one."""
    weights: dict[int | None, str] = {None: DEFAULT}
    if model.is_trained:
        weights = {t.seed: str(t.weights) for t in trainings if t.model == model.name and t.is_done}
    elif model.checkpoint is not None:
        seeds = [*config.seeds] if "{seed}" in model.checkpoint else [None]
        weights = {seed: model.checkpoint.replace("{seed}", str(seed)) for seed in seeds}
    training = training_config(training_words(model.train, config)) if model.kind == "constant" else None
    return [
        Method(
            model.name if seed is None else f"{model.name}/seed{seed}",
            partial(make_net, word, config, training),
            identity=training and [flat_settings(training.data, CHANGES_NOTHING), config.baseline_frames],
            label=model.label,
            seed=seed,
        )
        for seed, word in weights.items()
    ]


def make_net(word: str, config: DictConfig, training: DictConfig | None) -> DepthNetwork:
    """The network that a word stands for, or a map of constants, for the study's level and nearest depth.

    Args:
        word: as of ``make_method``.
        config: of the study.
        training: whose median a map of constants is.
    """
    level, scale = config.model.level, scale_of(config)
    if training is not None:
        depths = training_depths(training, level, config.baseline_frames)
        net: DepthNetwork = ConstantDepth(level, *scale).fit(*depths)
    else:
        net = make_method(word, level, scale).net
        net = net.with_changes(level=level if net.images == "sphere" else None)
    return net.to(choose_device(config.device))


def scale_of(config: DictConfig) -> Scale:
    """The hypotheses of a study's errors."""
    return Scale(config.num_hypotheses, config.model.min_depth)


def study_models(config: DictConfig) -> list[StudyModel]:
    """The models of ``config.models``, in order, and the network of ``config.checkpoint``; null is left out.

    Raises:
        ArgumentError: there is none, or one has an unknown kind or key.
    """
    models = [
        _model(str(name), OmegaConf.to_container(node, resolve=True))  # type: ignore[arg-type]
        for name, node in (config.models or {}).items()
        if node is not None
    ]
    if config.checkpoint is not None:
        label = Path(config.checkpoint).stem
        models.append(StudyModel("own", label, "depth_network", None, config.checkpoint))
    if not models:
        raise ArgumentError("models: expected at least one model, got none; see preset=small for examples")
    return models


def _model(name: str, entry: dict[str, Any]) -> StudyModel:
    for key in entry:
        check_choice(f"models.{name}", key, ("kind", "label", "train", "checkpoint"))
    kind, words = entry.get("kind", "depth_network"), entry.get("train")
    check_choice(f"models.{name}.kind", kind, KINDS)
    if kind == "constant" and words is None:
        raise ArgumentError(
            f"models.{name}.train: a constant depth map is the median of a training set; give the words that "
            "choose it, or [] for that of the words in training"
        )
    train = None if words is None else tuple(map(str, words))
    return StudyModel(name, entry.get("label") or name, kind, train, entry.get("checkpoint"))
