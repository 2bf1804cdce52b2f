# SPDX-License-Identifier: Apache-2.0
"""``Pipeline``: what is computed of each frame, from images to a network's answer."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.capture.graphs import GraphedFunction
from sphericalvision.capture.preparation.photometry import pixel_angles
from sphericalvision.capture.preparation.preparation import Compensator, Correction, Preparation, differs
from sphericalvision.geometry.directions import angle_from_axis
from sphericalvision.icosphere import icosphere_vertices
from sphericalvision.kernels import full_precision, may_hold
from sphericalvision.models import DepthNetwork
from sphericalvision.sphere.intake import signed, three_channels
from sphericalvision.sweep import DepthEstimate, DepthHint

BLANK = 1 / 255
"""Standard deviation of the values of an image, of [0, 1], below which it shows nothing: one step of 8 bits."""
PRECISIONS = ("float32", "bfloat16", "float16")


def in_precision(precision: str, device: torch.device) -> AbstractContextManager[object]:
    """Return the context in which a network computes in one of ``PRECISIONS``."""
    if precision == "float32":
        return nullcontext()
    # Casts are not cached, since a graph has to hold them.
    return torch.autocast(device.type, getattr(torch, precision), cache_enabled=False)


class Frame(NamedTuple):
    """What is computed of one frame or a batch of them, all on the device.

    Attributes:
        estimate: index, confidence and seen ``(*b, *grid)``, as of ``Depth``.
        corrections: of each frame, what was taken out of its images; none where that is not asked for.
        trust: ``(B, 1)`` of the network in the hint, 0 to 1; None without one, or where every hint is trusted.
    """

    estimate: DepthEstimate
    corrections: tuple[Correction, ...]
    trust: Float[Tensor, "B one"] | None = None


class Pipeline:
    """A network with everything that follows from a rig, computed once.

    On a device that is not a CPU nothing of a frame is read back before somebody asks for it, and on a CUDA device a
    frame is one graph.

    Args:
        network: at the scale of the rig, on its device.
        rig: unbatched.
        precision: of ``PRECISIONS``, that the network computes in; geometry and all that is done to images is float32.

    Attributes:
        network: as given.
        tables: the network's tables of the rig.
        intake: what makes images of the cameras into those that the network takes.
    """

    @full_precision
    @torch.inference_mode(False)  # what is kept must be usable where gradients are wanted
    def __init__(self, network: DepthNetwork, rig: CameraRig, precision: str = "float32") -> None:
        self.network, self.rig, self.precision = network, rig, precision
        self.tables, self.intake = network.tables(rig), network.intake(rig)
        self._compensator = Compensator(rig, self.intake.averaged)
        if network.images == "sphere":
            vertices = icosphere_vertices(network.image_level, torch.float32, network.device)
            directions = vertices.to(rig.world_from_camera) @ rig.world_from_camera[:, :3, :3]
            self._angles = angle_from_axis(directions).float()
        else:
            self._angles = torch.stack(list(pixel_angles(rig).values()))
        self.on_cuda = network.device.type == "cuda"
        graphed = GraphedFunction("the network", self.estimate)
        self._graphed = GraphedFunction("a frame", self.frame, partial(self.frame, estimate=graphed))

    def __call__(
        self,
        images: Mapping[str, Shaped[Tensor, "*batch c _ _"]],
        preparation: Preparation,
        hint: DepthHint | None = None,
    ) -> Frame:
        """Return the answer for images as ``ordered_images`` returns them, on the device of the network."""
        frame = self._graphed if self.on_cuda else self.frame
        result: Frame = frame(*images.values(), *(hint or ()), preparation=preparation)
        return result

    def frame(
        self, *images: Tensor, preparation: Preparation, estimate: GraphedFunction | None = None
    ) -> Frame:
        """Return the answer for the images of the cameras in order; ``estimate`` may stand for the network.

        The two parts of a hint ``(B, V)`` may come behind the images ``(*b, c, h, w)``.
        """
        number = len(self.rig)
        images, hint = images[:number], images[number:]
        colors = map(three_channels, images)
        inputs, corrections = self.inputs(dict(zip(self.rig.names, colors, strict=True)), preparation)
        result, trust = (estimate or self.estimate)(inputs, *hint)
        return Frame(result, corrections, trust)

    @full_precision
    def inputs(
        self, images: Mapping[str, Shaped[Tensor, "*batch 3 _ _"]], preparation: Preparation
    ) -> tuple[Float[Tensor, "*batch_and_size"], tuple[Correction, ...]]:
        """Return ``(*b, n, 3, *size)`` in [-1, 1], 0 where nothing was seen, and what was taken out of each frame.

        Args:
            images: camera name -> ``(*b, 3, h, w)`` in [0, 1], or bytes.
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
                if may_hold(differs(light)):
                    even = (frame / light.light(self._angles).to(frame)).clamp(0, 1)
                    frame.copy_(even.where(differs(light), frame))
            corrections.append(Correction(noise[place], gains[place], light))
        inputs = signed(values, self.intake.seen).unflatten(0, batch or (1,))
        return inputs[() if batch else 0], tuple(corrections)

    def estimate(
        self, inputs: Float[Tensor, "*batch_and_size"], *hint: Float[Tensor, "_ _"]
    ) -> tuple[DepthEstimate, Tensor | None]:
        """Return index, confidence and seen of what ``inputs`` returned, float32, with the same batch; and the trust.

        Args:
            inputs: of the method of that name.
            hint: inverse depth and weight of a ``DepthHint``, or nothing.
        """
        sizes = self.intake.seen.ndim + 1  # n, 3 and the size
        batch = inputs.shape[:-sizes]
        frames = inputs.reshape(-1, *inputs.shape[-sizes:])
        images = (frames, self.tables, self._shown(frames))
        trust = None
        with in_precision(self.precision, inputs.device):
            if hint:
                estimate, trust = self.network.predict_with_trust(*images, DepthHint(*hint))
            else:  # networks of others may not know what a hint is
                estimate = self.network.predict(*images)
        index, confidence, seen = (values.reshape(*batch, *values.shape[1:]) for values in estimate)
        return DepthEstimate(index.float(), confidence.float(), seen), trust

    @full_precision
    def _shown(self, frames: Tensor) -> Tensor:
        """Where images show something, ``(n, *size)`` or ``(B, n, *size)``.

        An image of one value, of a covered lens or a camera that failed, agrees with everything and with nothing: it
        shows nothing, so that depth is no surer for it, and not sure at all where fewer than two others look.
        """
        seen = self.intake.seen
        weight = seen.flatten(1).to(frames)
        weight /= weight.sum(1, keepdim=True).clamp(min=1)
        values = frames.flatten(3)
        mean = torch.einsum("bncv,nv->bnc", values, weight)
        variance = torch.einsum("bncv,nv->bnc", (values - mean[..., None]).square_(), weight).amax(2)
        blank = variance.view(*variance.shape, *(1,) * (seen.ndim - 1)) < (2 * BLANK) ** 2  # in [-1, 1]
        return seen & ~blank if may_hold(blank) else seen
