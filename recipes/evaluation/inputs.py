# SPDX-License-Identifier: Apache-2.0
"""The answer of any depth network where all are compared: at the vertices of an icosphere."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture import Predictor
from sphericalvision.capture.preparation.preparation import AS_IT_IS, Preparation
from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.models import DepthNetwork
from sphericalvision.recipes.datamodules.entries import images_of
from sphericalvision.recipes.training.rig_tables import RigTables
from sphericalvision.sphere.intake import unsigned

__all__ = ["PredictorEstimator", "VertexEstimator", "photographs_of"]

Sample = dict[str, Any]


class VertexEstimator:
    """The hypothesis index ``(B, V)`` that a network gives at the vertices of a batch's truth.

    Between the points of the network's grid it is linear. Where that does not reach, it is that of the nearest point.

    Args:
        net: the network.
        min_confidence: where the network is less confident, the index is NaN.
    """

    def __init__(self, net: DepthNetwork, min_confidence: float = 0.0) -> None:
        self.net, self.min_confidence = net, min_confidence
        self.tables = RigTables(net)

    def __call__(self, batch: Sample) -> Tensor:
        index, confidence = self._estimate(batch)
        number = batch["inverse_depth"].shape[-1]
        index = self._at_vertices(index, number)
        if self.min_confidence == 0:
            return index
        return index.where(self._at_vertices(confidence, number) >= self.min_confidence, math.nan)

    def reaches(self, directions: Tensor) -> Tensor:
        """Where the network says anything, ``(V,)`` of directions ``(V, 3)``."""
        nothing = torch.zeros(1, *self.net.grid.shape, device=self.net.device)
        return self.net.index_at(nothing, directions)[1]

    def _estimate(self, batch: Sample) -> tuple[Tensor, Tensor]:
        """Index and confidence on the network's grid, ``(B, *grid)``."""
        images, seen = images_of(batch, self.net)
        estimate = self.net.predict(images, self.tables.of(batch["rig"]), seen)
        return estimate.index, estimate.confidence

    def _at_vertices(self, values: Tensor, number: int) -> Tensor:
        if values.shape[1:] == (number,):
            return values
        vertices = Icosphere(level_from_num_vertices(number), device=values.device).vertices
        return self.net.index_at(values, vertices)[0]


class PredictorEstimator(VertexEstimator):
    """The same by way of a ``Predictor``: from the images of the cameras, as in use.

    Args:
        net: the network; errors are in its hypotheses, whichever the predictor takes.
        min_confidence: as of ``VertexEstimator``.
        min_depth: nearest hypothesis in metres; ``"auto"`` and ``"scene"`` as of ``Predictor``, of each frame.
        preparation: of each frame.
        masked: gives a rig masks, before it is used.
    """

    def __init__(
        self,
        net: DepthNetwork,
        min_confidence: float = 0.0,
        min_depth: float | Literal["auto", "scene"] = "auto",
        preparation: Preparation = AS_IT_IS,
        masked: Callable[[CameraRig], CameraRig] = lambda rig: rig,
    ) -> None:
        super().__init__(net, min_confidence)
        self.masked = masked
        self.options: dict[str, Any] = {"min_depth": min_depth, "preparation": preparation}

    def _estimate(self, batch: Sample) -> tuple[Tensor, Tensor]:
        answers = [self._frame(*frame) for frame in photographs_of(batch)]
        index, confidence = (torch.stack(values) for values in zip(*answers, strict=True))
        return index, confidence

    def _frame(self, rig: CameraRig, images: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        predictor = Predictor(self.masked(rig), self.net, **self.options)
        predictor.prepare([images])
        depth = predictor(images)
        nearer = self.net.min_depth / depth.min_depth  # the same inverse depth has another index
        return (depth.index * nearer).clamp(max=self.net.num_hypotheses - 1), depth.confidence


def photographs_of(batch: Sample) -> list[tuple[CameraRig, dict[str, Tensor]]]:
    """The rig and the images by camera of each frame of a batch, in [0, 1], black where lenses show nothing."""
    light = unsigned(batch["fisheye"]).clamp(0, 1) * batch["fisheye_seen"].unsqueeze(2)
    rigs = [batch["rig"].select(frame) for frame in range(len(light))]
    return [(rig, dict(zip(rig.names, images, strict=True))) for rig, images in zip(rigs, light, strict=True)]
