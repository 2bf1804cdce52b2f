# SPDX-License-Identifier: Apache-2.0
"""The study's measure: errors at vertices and on panoramas by every protocol that its tables show."""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sphericalvision.cameras import seen_by
from sphericalvision.icosphere import Icosphere
from sphericalvision.metrics import depth_error, depth_index_error, evaluation_mask, omnimvs_error, seam_mask
from sphericalvision.recipes.evaluation.methods import Answer, Scale
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import depth_from_index, index_from_inverse_depth, inverse_depth_from_index

ZONE = math.radians(30)
"""Latitude between the zone around the horizon and those above and below."""


class Truth(NamedTuple):
    """Truth of one batch, the same for all models.

    Attributes:
        indices: ``(B, V)`` in the hypotheses of the study, not rounded.
        inverse_depth: ``(B, V)`` 1/m.
        regions: by the protocols of ``Protocols.errors``, ``(B, V)`` where they count; "all" is where there is a truth.
        left_out: ``(B,)`` fraction of the valid points that fewer than two cameras see, 0 to 1.
        panorama: ``(B, h, w)`` inverse depth, 1/m.
        panorama_counts: ``(B, h, w)`` there is a truth that two or more cameras see.
        panorama_directions: ``(h * w, 3)``.
    """

    indices: Tensor
    inverse_depth: Tensor
    regions: dict[str, Tensor]
    left_out: Tensor
    panorama: Tensor
    panorama_counts: Tensor
    panorama_directions: Tensor


class Protocols:
    """The protocols at the vertices of an icosphere, and on panoramas.

    Args:
        scale: hypotheses of the study.
        level: of the icosphere.
        device: of the batches.
    """

    def __init__(self, scale: Scale, level: int, device: torch.device | str = "cpu") -> None:
        grid = Icosphere(level, device=device)
        self.key = {"generation": 3}
        self.scale, self.directions, self.solid_angles = scale, grid.vertices, grid.solid_angles
        seam = seam_mask(grid.vertices)
        height = -grid.vertices[:, 1]  # sine of the latitude; up is -y
        self.zones = {
            "seam": seam,
            "off_seam": ~seam,
            "above": height > math.sin(ZONE),
            "around": height.abs() <= math.sin(ZONE),
            "below": height < -math.sin(ZONE),
        }

    def truth(self, batch: dict[str, Any]) -> Truth:
        """Ground truth of a batch, and where it counts."""
        inverse_depth, valid = batch["inverse_depth"], batch["valid"]
        index = index_from_inverse_depth(inverse_depth, *self.scale)
        counts, left_out = evaluation_mask(batch["rig"], self.directions, inverse_depth, valid)
        cameras = seen_by(batch["rig"], self.directions, inverse_depth.where(valid, 0.0))
        regions = {"paper": counts, "all": valid}
        regions |= {name: counts & zone for name, zone in self.zones.items()}
        regions |= {"two": counts & (cameras == 2), "three": counts & (cameras == 3)}
        regions["four"] = counts & (cameras > 3)
        panorama, panorama_valid = batch["panorama_inverse_depth"], batch["panorama_valid"]
        around = Equirectangular.with_square_pixels(*panorama.shape[1:]).directions
        around = around.reshape(-1, 3).to(self.directions)
        seen, _ = evaluation_mask(batch["rig"], around, panorama.flatten(1), panorama_valid.flatten(1))
        shared = seen.view(panorama.shape)
        return Truth(index, inverse_depth, regions, left_out, panorama, shared, around)

    def errors(self, answer: Answer, truth: Truth) -> dict[str, dict[str, Tensor]]:
        """Errors ``(B,)`` of one batch, by protocol and name; NaN for frames where nothing counts.

        * ``paper``: percent of N over the vertices that two or more cameras see, each with the same weight;
        * ``all``: the same without leaving anything out;
        * ``solid_angle``: as ``paper``, vertices weighted by the solid angle that they stand for;
        * ``omnimvs``: the official protocol of OmniMVS, pixels of a panorama within 45° of the horizon, N = 192;
        * ``seam``, ``off_seam``: as ``paper`` within 5° of the seams of charts and panorama, and elsewhere;
        * ``above``, ``around``, ``below``: as ``paper``, over 30° above the horizon, within 30°, over 30° below;
        * ``two``, ``three``, ``four``: as ``paper``, points that two, three, and four or more cameras see;
        * ``depth``: AbsRel, RMSE in metres and the fraction within a factor 1.25, over the vertices of ``paper``;
        * ``points``: percent of the valid vertices left out, and of the others that the model says nothing about.
        """
        num_hypotheses = self.scale.num_hypotheses
        index, valid = answer.index_at(self.directions, self.scale)
        mask = truth.regions["paper"] & valid
        errors = {
            name: depth_index_error(index, truth.indices, num_hypotheses, region & valid)
            for name, region in truth.regions.items()
        }
        depth, true_depth = depth_from_index(index, *self.scale), truth.inverse_depth.reciprocal()
        shape = truth.panorama.shape
        around, around_valid = answer.index_at(truth.panorama_directions, self.scale)
        panorama = inverse_depth_from_index(around, *self.scale).view(shape)
        panorama_mask = truth.panorama_counts & around_valid.view(shape)
        return {
            **{name: errors.pop(name) for name in ("paper", "all")},
            "solid_angle": depth_index_error(index, truth.indices, num_hypotheses, mask, self.solid_angles),
            "omnimvs": omnimvs_error(panorama, truth.panorama, self.scale.min_depth, panorama_mask),
            **errors,
            "depth": depth_error(depth, true_depth, mask),
            "points": {
                "left_out": 100 * truth.left_out,
                "unknown": 100 * (1 - mask.sum(1) / truth.regions["paper"].sum(1)),
            },
        }
