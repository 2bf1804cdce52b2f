# SPDX-License-Identifier: Apache-2.0
"""The models of a study: what the config says of them, and how each estimates a batch."""

from __future__ import annotations

import math
from collections.abc import Callable
from inspect import Parameter, signature
from pathlib import Path
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.icosphere import Icosphere
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.datamodules.entries import images_of
from sphericalvision.recipes.evaluation.tables import Batch
from sphericalvision.recipes.training.rig_tables import RigTables
from sphericalvision.sweep import index_from_inverse_depth, inverse_depth_from_index, semi_global_sweep

__all__ = [
    "KINDS",
    "Estimate",
    "Lookup",
    "Scale",
    "StudyEstimator",
    "StudyModel",
    "constant_map",
    "make_estimator",
    "study_models",
]

KINDS = ("depth_network", "semi_global", "constant")


class Scale(NamedTuple):
    """What all estimates are brought to: vertices of ``level - 2``, and an index in these hypotheses."""

    level: int
    num_hypotheses: int
    min_depth: float


class Estimate(NamedTuple):
    """Index ``(B, V)`` in the hypotheses of the study, and where the model says anything ``(V,)``."""

    indices: Tensor
    known: Tensor


Lookup = Callable[[Tensor], Estimate]
"""What a model says of a batch in directions ``(V, 3)``."""

StudyEstimator = Callable[[Batch], Lookup]


class StudyModel(NamedTuple):
    """One entry of ``models`` in the config.

    Attributes:
        name: of its folders and in JSON.
        label: in tables and pictures.
        kind: "depth_network", "semi_global" (needs no training) or "constant" (a depth map for all frames).
        train: words of sphericalvision-train; for "constant" they say whose median it is.
        checkpoint: weights that are there already; ``{seed}`` stands for each seed. With neither, a network is the
            one that ships.
        options: of ``semi_global_sweep``, for "semi_global".
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

    @property
    def sweep_options(self) -> dict[str, Any]:
        """All options of ``semi_global_sweep``, those not given as they are by default; none for other kinds."""
        if self.kind != "semi_global":
            return {}
        usual = {name: p.default for name, p in signature(semi_global_sweep).parameters.items()}
        usual = {name: default for name, default in usual.items() if default is not Parameter.empty}
        del usual["seen"]  # comes with the frames
        for key in self.options:
            check_choice(f"models.{self.name}.options", key, tuple(usual))
        return {**usual, **self.options}

    def given_checkpoint(self, seed: int | None) -> Path | None:
        """The file of ``checkpoint``, if there is one."""
        return None if self.checkpoint is None else Path(self.checkpoint.replace("{seed}", str(seed)))


def study_models(config: DictConfig) -> list[StudyModel]:
    """The models of ``config.models``, in order; entries that are null are left out.

    Raises:
        ArgumentError: there is none, or one has an unknown kind or key.
    """
    models = []
    known = ("kind", "label", "train", "checkpoint", "options")
    for name, node in (config.models or {}).items():
        if node is None:
            continue
        entry: dict[str, Any] = OmegaConf.to_container(node, resolve=True)  # type: ignore[assignment]
        for key in entry:
            check_choice(f"models.{name}", key, known)
        check_choice(f"models.{name}.kind", entry.get("kind", "depth_network"), KINDS)
        words = entry.get("train")
        if entry.get("kind") == "constant" and words is None:
            raise ArgumentError(
                f"models.{name}.train: a constant depth map is the median of a training set; give the words that "
                "choose it, or [] for that of the words in training"
            )
        models.append(
            StudyModel(
                str(name),
                entry.get("label") or str(name),
                entry.get("kind", "depth_network"),
                None if words is None else tuple(map(str, words)),
                entry.get("checkpoint"),
                entry.get("options") or {},
            )
        )
    for model in models:
        _ = model.sweep_options  # wrong ones are told before anything is trained
    if not models:
        raise ArgumentError("models: expected at least one model, got none; see preset=small for examples")
    return models


def make_estimator(
    model: StudyModel, scale: Scale, weights: Path | None, constant: Tensor | None, device: torch.device
) -> StudyEstimator:
    """The estimator of one model; ``weights`` are those of a network, ``constant`` the index ``(V,)`` of a map."""
    if model.kind == "depth_network":
        return _network_estimator(weights, scale, device)
    on_grid = _lookups(Icosphere(scale.level - 2, device=device))
    if model.kind == "constant":
        assert constant is not None
        index = constant.to(device)
        return lambda batch: on_grid(index.expand(len(batch["valid"]), -1))
    options = {"num_hypotheses": scale.num_hypotheses, "min_depth": scale.min_depth, **model.sweep_options}
    return lambda batch: on_grid(
        semi_global_sweep(batch["images"], batch["rig"], seen=batch["seen"], **options).index
    )


def _network_estimator(weights: Path | None, scale: Scale, device: torch.device) -> StudyEstimator:
    net = load_network(weights)
    level = scale.level if net.images == "sphere" else None
    net = net.with_changes(level=level, min_depth=scale.min_depth).to(device)
    tables = RigTables(net)

    def estimator(batch: Batch) -> Lookup:
        images, seen = images_of(batch, net)
        index = net(images, tables.of(batch["rig"]), seen)

        def look_up(directions: Tensor) -> Estimate:
            same = directions.shape == net.grid.directions.shape and torch.equal(
                directions, net.grid.directions
            )
            known = torch.ones(len(directions), dtype=torch.bool, device=directions.device)
            found, known = (index, known) if same else net.index_at(index, directions)
            inverse_depth = inverse_depth_from_index(found.float(), net.num_hypotheses, net.min_depth)
            return Estimate(
                index_from_inverse_depth(inverse_depth, scale.num_hypotheses, scale.min_depth), known
            )

        return look_up

    return estimator


def _lookups(grid: Icosphere) -> Callable[[Tensor], Lookup]:
    """Indices ``(B, V)`` on a grid to what they are elsewhere: linear in each triangle."""

    def make(index: Tensor) -> Lookup:
        def look_up(directions: Tensor) -> Estimate:
            known = torch.ones(len(directions), dtype=torch.bool, device=directions.device)
            if torch.equal(directions, grid.vertices):
                return Estimate(index, known)
            values = grid.sample(index[:, None], directions.expand(len(index), -1, -1))[:, 0]
            return Estimate(values, known)

        return look_up

    return make


def constant_map(inverse_depths: Tensor, valid: Tensor, scale: Scale) -> Tensor:
    """Index ``(V,)`` of the depth map with the least mean absolute error over frames ``(F, V)``: their median.

    Raises:
        ArgumentError: no frame has a valid depth.

    Examples:
        >>> truth = torch.tensor([[0.0], [1.0], [2.0]])
        >>> constant_map(truth, torch.ones(3, 1, dtype=torch.bool), Scale(2, 5, 0.5))
        tensor([2.])
    """
    index = index_from_inverse_depth(inverse_depths, scale.num_hypotheses, scale.min_depth)
    index = index.where(valid, math.nan)
    whole = index.nanmedian()
    if whole.isnan():
        raise ArgumentError("constant: the training set has no valid depth to take the median of")
    each = index.nanmedian(0).values
    return each.where(~each.isnan(), whole)
