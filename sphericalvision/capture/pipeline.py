# SPDX-License-Identifier: Apache-2.0
"""``Pipeline``: what is computed of each frame, from images to a network's answer."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.preparation.preparation import Compensation, Compensator, Preparation
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
        self._angles = torch.empty(
            0
        )  # (n, V) radians from each camera's axis, where images are on icospheres
        if network.images == "sphere":
            vertices = icosphere_vertices(network.level, torch.float32, network.device)
            directions = vertices.to(rig.world_from_camera) @ rig.world_from_camera[:, :3, :3]
            self._angles = angle_from_axis(directions).float()

    @full_precision
    def inputs(
        self, images: Mapping[str, Float[Tensor, "*batch 3 _ _"]], preparation: Preparation
    ) -> tuple[Float[Tensor, "*batch_and_size"], tuple[Compensation, ...]]:
        """Return ``(*b, n, 3, *size)`` in [-1, 1], 0 where nothing was seen, and what was taken out of each frame.

        Args:
            images: camera name -> ``(*b, 3, h, w)`` in [0, 1].
            preparation: of the images.
        """
        if preparation.of_images is None:
            return self.intake(images), ()
        compensator = self._compensator
        bright, gains = compensator.brightened(images)
        smooth, noise = compensator.smoothed(bright)
        flat = {name: image.reshape(-1, *image.shape[-3:]) for name, image in smooth.items()}
        frames = [{name: images[frame] for name, images in flat.items()} for frame in range(len(noise))]
        lights = [compensator.light(frame) if len(self.rig) > 1 else None for frame in frames]
        compensations = tuple(map(Compensation, noise, lights, gains))
        if self.network.images == "camera":
            even = [compensator.evened(frame, light) for frame, light in zip(frames, lights, strict=True)]
            stacked = {n: torch.stack([frame[n] for frame in even]).view_as(smooth[n]) for n in smooth}
            return self.intake(stacked), compensations
        # On the icosphere there are fewer values to divide than in the images.
        values = self.intake.looked_up(smooth)
        for frame, light in zip(values.view(-1, *values.shape[-3:]), lights, strict=True):
            if light is not None:
                frame.div_(light.light(self._angles)).clamp_(0, 1)
        return signed(values, self.intake.seen), compensations

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
