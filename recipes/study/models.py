# SPDX-License-Identifier: Apache-2.0
"""The models of a study: what the configuration says of them, and the network that each is."""

from __future__ import annotations

from functools import cached_property
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.models import ConstantDepth, DepthNetwork, SemiGlobalSweep, WinnerTakesAll
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.app.cli import choose_device
from sphericalvision.recipes.evaluation.methods import Method, Scale, identity_of
from sphericalvision.recipes.evaluation.views import training_depths
from sphericalvision.recipes.study.training import flat_config, training_config, training_words

__all__ = ["KINDS", "StudyModel", "Version", "scale_of", "study_models"]

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

    def seeds(self, seeds: list[int]) -> list[int | None]:
        """The seeds it has: all, or ``[None]`` for a model that has only one version."""
        several = self.is_trained or (self.checkpoint is not None and "{seed}" in self.checkpoint)
        return [*seeds] if several else [None]

    def given_checkpoint(self, seed: int | None) -> Path | None:
        """The file of ``checkpoint``, if there is one."""
        return None if self.checkpoint is None else Path(self.checkpoint.replace("{seed}", str(seed)))


class Version:
    """A model as it is evaluated: of one seed.

    Args:
        model: which.
        seed: of its training; None for a model that has only one version.
        weights: of a network; None for the one that ships, and for what has none.
        config: of the study.
    """

    def __init__(self, model: StudyModel, seed: int | None, weights: Path | None, config: DictConfig) -> None:
        self.model, self.seed, self.weights, self.config = model, seed, weights, config

    @property
    def name(self) -> str:
        """Of its folder below ``evaluation``."""
        return self.model.name if self.seed is None else f"{self.model.name}/seed{self.seed}"

    @cached_property
    def net(self) -> DepthNetwork:
        """The network, for the study's level and nearest depth; a map of constants is found when asked for."""
        level, (number, min_depth) = self.config.model.level, scale_of(self.config)
        if self.model.kind in SWEEPS:
            return SWEEPS[self.model.kind](level, number, min_depth, **self.model.options)
        if self.model.kind == "constant":
            depths = training_depths(self._training, level, self.config.baseline_frames)
            return ConstantDepth(level, number, min_depth).fit(*depths)
        net = load_network(self.weights)
        return net.with_changes(level=level if net.images == "sphere" else None, min_depth=min_depth)

    @property
    def method(self) -> Method:
        """The method to evaluate."""
        return Method(self.name, self.net.to(choose_device(self.config.device)))

    @property
    def identity(self) -> Any:
        """What its estimates depend on."""
        if self.model.kind != "constant":
            return identity_of(self.net)
        return [flat_config(self._training.data), self.config.baseline_frames]

    @property
    def _training(self) -> DictConfig:
        return training_config(training_words(self.model.train, self.config))


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
