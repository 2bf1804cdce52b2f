# SPDX-License-Identifier: Apache-2.0
"""``Pipeline``: what is computed of each frame, from images to a network's answer."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.preparation.photometry import pixel_angles
from sphericalvision.capture.preparation.preparation import (
    Compensator,
    Correction,
    Preparation,
    differs,
    needed,
)
from sphericalvision.core import full_precision
from sphericalvision.geometry.directions import angle_from_axis
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.models import DepthNetwork
from sphericalvision.sphere.intake import signed

__all__ = ["Pipeline"]


class Pipeline:
    """A network with everything that follows from a rig, computed once.

    Args:
        network: at the scale of the rig, on its device.
        rig: unbatched.

    Attributes:
        network: as given.
        tables: the network's tables of the rig.
        intake: what makes images of the cameras into those that the network takes.
    """

    @full_precision
    @torch.inference_mode(False)  # what is kept must be usable where gradients are wanted
    def __init__(self, network: DepthNetwork, rig: CameraRig) -> None:
        self.network, self.rig = network, rig
        self.tables, self.intake = network.tables(rig), network.intake(rig)
        self._compensator = Compensator(rig)
        if network.images == "sphere":
            vertices = icosphere_vertices(network.level, torch.float32, network.device)
            directions = vertices.to(rig.world_from_camera) @ rig.world_from_camera[:, :3, :3]
            self._angles = angle_from_axis(directions).float()
        else:
            self._angles = torch.stack(list(pixel_angles(rig).values()))

    @full_precision
    def inputs(
        self, images: Mapping[str, Float[Tensor, "*batch 3 _ _"]], preparation: Preparation
    ) -> tuple[Float[Tensor, "*batch_and_size"], tuple[Correction, ...]]:
        """Return ``(*b, n, 3, *size)`` in [-1, 1], 0 where nothing was seen, and what was taken out of each frame.

        Args:
            images: camera name -> ``(*b, 3, h, w)`` in [0, 1].
            preparation: of the images.
        """
        if preparation.of_images is None:
            return self.intake(images), ()
        compensator = self._compensator
        batch = next(iter(images.values())).shape[:-3]
        flat = {name: image.reshape(-1, *image.shape[-3:]) for name, image in images.items()}
        bright, gains = compensator.brightened(flat)
        smooth, noise = compensator.smoothed(bright)
        # Light is divided out of what was looked up: on an icosphere there are fewer values than in the images.
        values = self.intake.looked_up(smooth)
        corrections = []
        for place, frame in enumerate(values):
            light = None
            if len(self.rig) > 1:
                light = compensator.light({name: image[place] for name, image in smooth.items()})
                if needed(differs(light)):
                    even = (frame / light.light(self._angles).to(frame)).clamp(0, 1)
                    frame.copy_(even.where(differs(light), frame))
            corrections.append(Correction(noise[place], gains[place], light))
        return signed(values, self.intake.seen).unflatten(0, batch or (1,))[() if batch else 0], tuple(
            corrections
        )

    def estimate(
        self, inputs: Float[Tensor, "*batch_and_size"]
    ) -> tuple[
        Float[Tensor, "*batch_and_grid"], Float[Tensor, "*batch_and_grid"], Bool[Tensor, "*batch_and_grid"]
    ]:
        """Return index, confidence and seen of what ``inputs`` returned, float32, with the same batch."""
        sizes = self.intake.seen.ndim + 1  # n, 3 and the size
        batch = inputs.shape[:-sizes]
        estimate = self.network.predict(
            inputs.reshape(-1, *inputs.shape[-sizes:]), self.tables, self.intake.seen
        )
        index, confidence, seen = (values.reshape(*batch, *values.shape[1:]) for values in estimate)
        return index.float(), confidence.float(), seen
