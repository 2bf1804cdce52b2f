# SPDX-License-Identifier: Apache-2.0
"""The metrics of Helvipad, and its published table: errors along the rays of the camera that has the truth."""

from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from sphericalvision.data.scanned.helvipad import HELVIPAD_LATITUDES, disparity_from_depth
from sphericalvision.metrics import left_right_error, stereo_error
from sphericalvision.recipes.evaluation.loop import VertexErrors
from sphericalvision.recipes.evaluation.methods import Answer, Batch, Scale
from sphericalvision.recipes.evaluation.records import Record
from sphericalvision.recipes.evaluation.tables import Cell, Table
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import inverse_depth_from_index

MAX_DEPTH = 256.0
"""Metres that maps of depth can hold; estimates beyond count as this."""
STEPS = 4
COLUMNS = (("depth", "MAE", "m"), ("depth", "RMSE", "m"), ("depth", "MARE", "1"), ("depth", "LRCE", "m"))
MORE = (("disparity", "MAE", "°"), ("disparity", "RMSE", "°"), ("disparity", "MARE", "°/°"))


class StripErrors(VertexErrors):
    """Errors at the vertices, and those of Helvipad along the rays of its bottom camera, the first of the rig."""

    def truth(self, batch: Batch) -> Any:
        """Truth of ``VertexErrors``, and the batch with the maps of depth."""
        return super().truth(batch), batch

    def errors(self, answer: Answer, truth: Any) -> dict[str, Any]:
        """Errors of ``VertexErrors``; ``depth`` in metres and ``disparity`` in degrees."""
        at_vertices, batch = truth
        errors = super().errors(answer, at_vertices)
        rig, depth, augmented = (batch[key] for key in ("rig", "strip_depth", "strip_depth_augmented"))
        height, width = depth.shape[-2:]
        grid = Equirectangular(height, width, latitudes=HELVIPAD_LATITUDES, device=depth.device)
        estimate = torch.zeros_like(depth)
        measured = (depth > 0) | (augmented > 0)
        for frame, pixels in enumerate(measured):
            offset = (rig.positions[frame, 0] - rig.center[frame]).to(depth)
            estimate[frame, pixels] = depth_off_center(
                answer, frame, grid.directions[pixels], offset, self.scale
            ).to(depth)
        pairs = {"depth": (estimate, depth)}
        pairs["disparity"] = tuple(disparity_from_depth(v, grid.directions) for v in pairs["depth"])  # type: ignore[assignment]
        for name, (estimated, true) in pairs.items():
            errors[name] = stereo_error(estimated.flatten(1), true.flatten(1), (depth > 0).flatten(1))
        errors["depth"] |= left_right_error(estimate, augmented)
        return errors


def depth_off_center(answer: Answer, frame: int, rays: Tensor, offset: Tensor, scale: Scale) -> Tensor:
    """Depth ``(V,)`` along rays from a place off the rig's centre: where they meet the estimated surface.

    Args:
        answer: estimates around the centre.
        frame: of the batch.
        rays: ``(V, 3)``.
        offset: ``(3,)`` of their origin from the centre, small compared with the depths.
        scale: of the estimate.
    """
    alone = Answer(answer.net, type(answer.estimate)(*(v[frame : frame + 1] for v in answer.estimate)))
    along, towards, depth = rays @ offset, rays, rays.new_zeros(len(rays))
    for _ in range(STEPS):
        # The estimate where the ray is, and where the ray is at that distance from the centre.
        index = alone.index_at(towards, scale)[0][0]
        distance = 1 / inverse_depth_from_index(index, *scale).clamp(min=1 / MAX_DEPTH)
        # |offset + depth * ray| = distance, solved for the depth
        depth = (along.square() - offset.square().sum() + distance.square()).clamp(min=0).sqrt() - along
        towards = F.normalize(offset + depth[:, None] * rays, dim=-1)
    return depth


def table_with_published(records: Mapping[str, Record], published: Mapping[str, tuple[float, ...]]) -> Table:
    """A table of measured errors, and below them those that were published of others."""

    def cell(value: float | None) -> Cell | None:
        return None if value is None else Cell(value, digits=3)

    means = {name: record.means for name, record in records.items()}
    measured = [
        [name, *(cell(mean[what][error]) for what, error, _ in (*COLUMNS, *MORE))]
        for name, mean in means.items()
    ]
    others = [[f"{name} *", *map(cell, row), *[None] * len(MORE)] for name, row in published.items()]
    columns = ("", *(f"{error} ({unit})" for _, error, unit in (*COLUMNS, *MORE)))
    title = "of depth, and of disparity (°); * published, of the whole test set and older maps of depth"
    return Table(title, columns, [*measured, *others])
