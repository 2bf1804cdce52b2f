# SPDX-License-Identifier: Apache-2.0
"""The models of a study: what the configuration says of them, and the network that each is."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.models import ConstantDepth, DepthNetwork, SemiGlobalSweep, WinnerTakesAll
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.app.cli import choose_device
from sphericalvision.recipes.evaluation.methods import Method, Scale
from sphericalvision.recipes.study.training import CHANGES_NOTHING, Training, training_config, training_words
from sphericalvision.recipes.study.views import training_depths
from sphericalvision.recipes.training.run_folder import flat_settings

__all__ = ["KINDS", "StudyModel", "methods_of", "scale_of", "study_models"]

SWEEPS: dict[str, type[SemiGlobalSweep] | type[WinnerTakesAll]] = {
    "semi_global": SemiGlobalSweep,
    "winner_takes_all": WinnerTakesAll,
}
KINDS = ("depth_network", *SWEEPS, "constant")


class StudyModel(NamedTuple):
    """One entry of ``models`` in the config.

    Attributes:
        name: of its folders and in JSON.
        label: in tables and pictures.
        kind: "depth_network", a sweep that needs no training, or "constant" (a depth map for all frames).
        train: words of sphericalvision-train; for "constant" they say whose median it is.
        checkpoint: weights that are there already; ``{seed}`` stands for each seed. With neither, a network is the
            one that ships.
        options: hyper-parameters of a sweep.
    """

    name: str
    label: str
    kind: str
    train: tuple[str, ...] | None
    checkpoint: str | None
    options: dict[str, Any]

    @property
    def is_trained(self) -> bool:
        """Whether the study trains it, once a seed."""
        return self.kind == "depth_network" and self.train is not None and self.checkpoint is None


def methods_of(model: StudyModel, config: DictConfig, trainings: Sequence[Training]) -> list[Method]:
    """The method of each seed of a model, but for seeds that are not trained; of a model without seeds the one."""
    weights: dict[int | None, Path | None] = {None: None}
    if model.is_trained:
        weights = {t.seed: t.weights for t in trainings if t.model == model.name and t.is_done}
    elif model.checkpoint is not None:
        seeds = [*config.seeds] if "{seed}" in model.checkpoint else [None]
        weights = {seed: Path(model.checkpoint.replace("{seed}", str(seed))) for seed in seeds}
    training = training_config(training_words(model.train, config)) if model.kind == "constant" else None
    return [
        Method(
            model.name if seed is None else f"{model.name}/seed{seed}",
            partial(make_net, model, path, config, training),
            identity=training and [flat_settings(training.data, CHANGES_NOTHING), config.baseline_frames],
            label=model.label,
            seed=seed,
        )
        for seed, path in weights.items()
    ]


def make_net(
    model: StudyModel, weights: Path | None, config: DictConfig, training: DictConfig | None
) -> DepthNetwork:
    """The network of a model, for the study's level and nearest depth.

    Args:
        model: which.
        weights: of a network; None for the one that ships, and for what has none.
        config: of the study.
        training: whose median a map of constants is.
    """
    level, (number, min_depth) = config.model.level, scale_of(config)
    net: DepthNetwork
    if model.kind in SWEEPS:
        net = SWEEPS[model.kind](level, number, min_depth, **model.options)
    elif training is not None:
        depths = training_depths(training, level, config.baseline_frames)
        net = ConstantDepth(level, number, min_depth).fit(*depths)
    else:
        net = load_network(weights)
        net = net.with_changes(level=level if net.images == "sphere" else None, min_depth=min_depth)
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
        models.append(StudyModel("own", label, "depth_network", None, config.checkpoint, {}))
    if not models:
        raise ArgumentError("models: expected at least one model, got none; see preset=small for examples")
    return models


def _model(name: str, entry: dict[str, Any]) -> StudyModel:
    for key in entry:
        check_choice(f"models.{name}", key, ("kind", "label", "train", "checkpoint", "options"))
    kind, words, options = entry.get("kind", "depth_network"), entry.get("train"), entry.get("options") or {}
    check_choice(f"models.{name}.kind", kind, KINDS)
    if kind == "constant" and words is None:
        raise ArgumentError(
            f"models.{name}.train: a constant depth map is the median of a training set; give the words that "
            "choose it, or [] for that of the words in training"
        )
    if kind in SWEEPS:
        for key in options:  # wrong ones are told before anything is trained
            check_choice(f"models.{name}.options", key, tuple(signature(SWEEPS[kind]).parameters)[3:])
    train = None if words is None else tuple(map(str, words))
    return StudyModel(name, entry.get("label") or name, kind, train, entry.get("checkpoint"), options)
