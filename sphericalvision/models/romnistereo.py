# SPDX-License-Identifier: Apache-2.0
"""RomniStereo: correlations of two pairs of opposite cameras, and a recurrent unit that improves the index."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sphericalvision.core import ArgumentError, check_choice, check_counts
from sphericalvision.models.depth_network import DepthNetwork
from sphericalvision.models.omnimvs_parts import FisheyeFeatures, ImageConv
from sphericalvision.models.weights.registry import register_network
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import DepthEstimate, DepthHint, PanoramaSweep
from sphericalvision.sweep.panorama_sweep import PanoramaTables

if TYPE_CHECKING:
    from sphericalvision.cameras import CameraRig

PYRAMID = 4
"""Scales of the correlation along the hypotheses, each half as fine as the one before."""
RADIUS = 4
"""Hypotheses of a scale that are looked up to either side of the current one."""
HIDDEN = 64
"""Channels of the motion encoder; the heads have twice as many."""
DECAY, TRAINED_ITERATIONS = 0.9, 15
"""Iteration i of n has the weight ``DECAY ** (TRAINED_ITERATIONS / n * (n - 1 - i))`` in the loss."""


class RomniStereo(DepthNetwork):
    """Depth on a panorama from four fisheye cameras, front, right, back and left, by recurrent refinement.

    Front and back are swept and mixed into one volume, right and left into another, by weights from the features and
    their positions in the images: two views of everything, as of a stereo pair. Their correlation is computed once. In
    each iteration a gated recurrent unit looks up the correlations around the index of each pixel and moves it.

    Convention:
        As for ``OmniMVS``, with two differences that checkpoints of the authors depend on: grey is the sum of the
        channels, and the outermost pixel centres of an image and of its features coincide (``grid_sample`` with aligned
        corners). A pixel of the swept spheres is the middle of four of the result. The confidence is 1 / (1 + m), where
        the last iteration moved the index by m hypotheses.

    Args:
        num_hypotheses: N, an even number; every second sphere is swept.
        min_depth: radius of the smallest sphere in metres.
        feature_channels: C, channels of a camera's features; 32, 8 or 4 in the paper.
        output_size: (height, width) of the panorama, both even: see ``OmniMVS``.
        in_channels: 1 for grey images, as in the paper, or 3.
        norm: ``"batch"``, as in the paper, or ``"instance"``, for training with batches of one or two.
        iterations: of the recurrent unit; 12 in the paper. Weights do not depend on it.

    Raises:
        ArgumentError: if sizes, channels or iterations are not positive, or not even where they have to be.

    References:
        Jiang, Zhu, Ma, Wang and Zhu (2024), "RomniStereo: recurrent omnidirectional stereo matching"; Teed and Deng
        (2020), "RAFT: recurrent all-pairs field transforms for optical flow"; Lipson, Teed and Deng (2021),
        "RAFT-Stereo".

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> net = RomniStereo(16, feature_channels=2, output_size=(8, 16), iterations=2).eval()
        >>> net(torch.zeros(1, 4, 3, 32, 40), ring_rig(4, image_size=(32, 40))).shape
        torch.Size([1, 8, 16])
    """

    images = "camera"
    grid: Equirectangular

    def __init__(
        self,
        num_hypotheses: int = 192,
        min_depth: float = 0.55,
        feature_channels: int = 32,
        output_size: Sequence[int] = (160, 640),
        in_channels: int = 1,
        norm: str = "batch",
        iterations: int = 12,
    ) -> None:
        super().__init__(num_hypotheses, min_depth, num_cameras=4)
        sizes = tuple(output_size)
        if len(sizes) != 2 or any(not isinstance(size, int) or size < 2 or size % 2 for size in sizes):
            raise ArgumentError(f"output_size: expected an even height and an even width, got {list(sizes)}")
        fewest = 2**PYRAMID
        if num_hypotheses % 2 or num_hypotheses < fewest:
            raise ArgumentError(
                f"num_hypotheses: expected an even number of {fewest} or more, as every second sphere is swept and "
                f"{PYRAMID} scales halve these, got {num_hypotheses}"
            )
        check_counts(feature_channels=feature_channels, iterations=iterations)
        check_choice("in_channels", in_channels, (1, 3))
        self.in_channels, self.iterations = in_channels, iterations
        self.image_channels = (1, 3) if in_channels == 1 else (3,)
        self.grid = Equirectangular.with_square_pixels(*sizes)
        self.features = FisheyeFeatures(feature_channels, in_channels, norm)
        self.sweep = AlignedSweep((sizes[0] // 2, sizes[1] // 2), num_hypotheses, min_depth)
        self.reference, self.target = Mixing(feature_channels), Mixing(feature_channels)
        self.initial = ImageConv(feature_channels, 2 * feature_channels, 1, norm=norm)
        self.update = Update(feature_channels)

    def tables(self, rig: CameraRig) -> PanoramaTables:
        """Return the tables of a rig, which may be passed in its place."""
        return self.sweep.tables(rig)

    def _estimate(
        self, images: Tensor, rig: CameraRig | PanoramaTables, seen: Tensor | None, hint: DepthHint | None
    ) -> DepthEstimate:
        tables, indices = self._indices(images, rig)
        index = indices[-1].clamp(0, self.num_hypotheses - 1)
        moved = (indices[-1] - indices[-2] if len(indices) > 1 else indices[-1]).abs()
        # Four pixels of the result share a pixel of the spheres, and so their ``seen``.
        coarse = F.avg_pool2d(index.detach()[:, None], 2).squeeze(1) / self.sweep.every
        sphere = coarse.round().long().clamp(max=tables.seen.shape[-3] - 1)
        views = self.sweep.seen(tables.at_spheres(sphere), seen).squeeze(-3).sum(-3)
        joined = (views >= 2).repeat_interleave(2, -2).repeat_interleave(2, -1)
        return DepthEstimate(index, 1 / (1 + moved), joined)

    def training_loss(
        self,
        images: Float[Tensor, "B 4 C H W"],
        rig: CameraRig | PanoramaTables,
        seen: Bool[Tensor, "B 4 H W"] | Bool[Tensor, "4 H W"] | None,
        target: Float[Tensor, "B h w"],
        valid: Bool[Tensor, "B h w"],
        loss: Callable[..., Tensor],
        hint: DepthHint | None = None,
    ) -> Float[Tensor, ""]:
        """Return the loss of every iteration, the later the heavier; arguments as in ``DepthNetwork``."""
        self.check_images(images, seen, hint)
        indices = self._indices(images, rig)[1]
        spacing = TRAINED_ITERATIONS / len(indices)
        weights = [DECAY ** (spacing * (len(indices) - 1 - i)) for i in range(len(indices))]
        losses = [w * loss(index, target, valid) for w, index in zip(weights, indices, strict=True)]
        return torch.stack(losses).sum()

    def _indices(
        self, images: Tensor, rig: CameraRig | PanoramaTables
    ) -> tuple[PanoramaTables, list[Tensor]]:
        """The tables of the rig, and the index ``(B, h, w)`` after each iteration."""
        tables = self.sweep.tables_for(images, rig)
        if self.in_channels == 1:
            images = images.sum(2, keepdim=True)
        flat = images.flatten(0, 1).contiguous(memory_format=torch.channels_last)
        maps = self.features(flat).unflatten(0, images.shape[:2])
        self.sweep.check_maps(maps, tables)
        return tables, self.refined(*self.volumes(maps, tables))

    def volumes(
        self, maps: Float[Tensor, "B 4 C h_f w_f"], tables: PanoramaTables
    ) -> tuple[Float[Tensor, "B C h_2 w_2 D"], Float[Tensor, "B C h_2 w_2 D"]]:
        """Return the reference, of cameras 1 and 3, and the target, of 2 and 4, ``(B, C, h / 2, w / 2, N / 2)``."""
        swept = [
            self.sweep.camera_values(features, tables, camera).movedim(2, -1)
            for camera, features in enumerate(maps.unbind(1))
        ]
        coordinates = tables.grid.to(maps.dtype)
        coordinates = coordinates.expand(len(maps), *coordinates.shape[-5:]).movedim(-1, 2).movedim(3, -1)
        front, right, back, left = coordinates.unbind(1)
        return self.reference(swept[0], swept[2], front, back), self.target(swept[1], swept[3], right, left)

    def refined(
        self, reference: Float[Tensor, "B C h_2 w_2 D"], target: Float[Tensor, "B C h_2 w_2 D"]
    ) -> list[Float[Tensor, "B h w"]]:
        """Return the index after each iteration, not yet limited to 0..N - 1."""
        correlation = (reference * target).sum(1, keepdim=True) / reference.shape[1] ** 0.5
        scales = [correlation]
        while len(scales) < PYRAMID:
            finer = scales[-1][..., : scales[-1].shape[-1] // 2 * 2]
            scales.append(finer.unflatten(-1, (-1, 2)).mean(-1))
        state = torch.tanh(self.initial(reference[..., 0]))
        index = torch.zeros_like(correlation[:, 0, ..., 0])
        window = torch.arange(-RADIUS, RADIUS + 1, device=index.device).to(index.dtype)
        indices = []
        for _ in range(self.iterations):
            # Each iteration learns its own step alone, as in RAFT.
            index = index.detach()
            neighbors = [
                at_hypotheses(values, index.unsqueeze(-1) / 2**k + window) for k, values in enumerate(scales)
            ]
            clues = torch.cat(neighbors, -1).squeeze(1).movedim(-1, 1)
            last = reference.shape[-1] - 1
            context = at_hypotheses(reference, index.clamp(0, last).unsqueeze(-1)).squeeze(-1)
            state, step, weights = self.update(state, clues, context, index)
            index = index + step
            indices.append(upsampled(self.sweep.every * index, weights))
        return indices


class AlignedSweep(PanoramaSweep):
    """A sweep with positions from -1 at the first pixel centre of the image to 1 at the last."""

    align_corners, outside = True, -2.0

    def _normalized(self, pixels: Tensor, seen: Tensor, image_size: tuple[int, int]) -> Tensor:
        last = pixels.new_tensor([image_size[1] - 1, image_size[0] - 1])
        coordinates = torch.minimum(pixels.clamp(min=0), last)
        return torch.where(seen.unsqueeze(-1), 2 * coordinates / last - 1, self.outside)


class Mixing(nn.Module):
    """The features of two opposite cameras as one: w times the first and 1 - w times the second, point by point."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv3d(2 * channels + 4, channels, 1)
        self.second = nn.Conv3d(channels, 1, 1)

    def forward(self, one: Tensor, other: Tensor, place: Tensor, other_place: Tensor) -> Tensor:
        """Of features ``(B, C, h, w, D)`` and their places in the images ``(B, 2, h, w, D)``."""
        hidden = F.relu(self.first(torch.cat((one, other, place, other_place), 1)))
        return torch.lerp(other, one, torch.sigmoid(self.second(hidden)))


class Update(nn.Module):
    """One iteration: a convolutional gated recurrent unit, fed with correlations, index and context.

    References:
        Cho et al. (2014), "Learning phrase representations using RNN encoder-decoder"; Teed and Deng (2020), "RAFT",
        section 3.3 and, for the upsampling by convex combinations, appendix B.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        state, width, motion = 2 * channels, HIDDEN, 2 * HIDDEN
        self.correlation = nn.ModuleList(
            (nn.Conv2d(PYRAMID * (2 * RADIUS + 1), width, 1), nn.Conv2d(width, width, 3, padding=1))
        )
        self.index = nn.ModuleList((nn.Conv2d(1, width, 7, padding=3), nn.Conv2d(width, width, 3, padding=1)))
        self.motion = nn.Conv2d(2 * width, motion - 1, 3, padding=1)  # the index itself is the last channel
        inputs = state + channels + motion
        self.keep, self.reset, self.proposal = (nn.Conv2d(inputs, state, 3, padding=1) for _ in range(3))
        self.step = nn.ModuleList(
            (nn.Conv2d(state, motion, 3, padding=1), nn.Conv2d(motion, 1, 3, padding=1))
        )
        self.weights = nn.ModuleList((nn.Conv2d(state, motion, 3, padding=1), nn.Conv2d(motion, 36, 1)))

    def forward(
        self, state: Tensor, clues: Tensor, context: Tensor, index: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the state ``(B, 2 C, h, w)``, the step of the index ``(B, h, w)`` and logits ``(B, 36, h, w)``."""
        index = index.unsqueeze(1)
        correlation_features, index_features = clues, index
        for convolve, look in zip(self.correlation, self.index, strict=True):
            correlation_features, index_features = (
                F.relu(convolve(correlation_features)),
                F.relu(look(index_features)),
            )
        motion = F.relu(self.motion(torch.cat((correlation_features, index_features), 1)))
        inputs = torch.cat((F.relu(context), motion, index), 1)
        joined = torch.cat((state, inputs), 1)
        keep, reset = torch.sigmoid(self.keep(joined)), torch.sigmoid(self.reset(joined))
        proposal = torch.tanh(self.proposal(torch.cat((reset * state, inputs), 1)))
        state = torch.lerp(state, proposal, keep)
        step = self.step[1](F.relu(self.step[0](state))).squeeze(1)
        # A quarter keeps the gradients of the weights in balance with those of the step, as in RAFT.
        return state, step, 0.25 * self.weights[1](F.relu(self.weights[0](state)))


def at_hypotheses(
    values: Float[Tensor, "B C h w D"], index: Float[Tensor, "B h w m"]
) -> Float[Tensor, "B C h w m"]:
    """Values between hypotheses, linear, and zero beyond the first and the last one.

    Examples:
        >>> at_hypotheses(torch.tensor([1.0, 3.0]).view(1, 1, 1, 1, 2), torch.tensor([[[[0.5, 1.5, 3.0]]]])).flatten()
        tensor([2.0000, 1.5000, 0.0000])
    """
    padded = F.pad(values, (1, 1))  # a hypothesis of zeros at either end
    position = (index + 1).clamp(0, padded.shape[-1] - 1)
    below = position.detach().floor().clamp(max=padded.shape[-1] - 2)
    fraction = (position - below).unsqueeze(1)
    below = below.long().unsqueeze(1).expand(-1, values.shape[1], -1, -1, -1)
    return torch.lerp(padded.gather(-1, below), padded.gather(-1, below + 1), fraction)


def upsampled(
    index: Float[Tensor, "B h w"], weights: Float[Tensor, "B 36 h w"]
) -> Float[Tensor, "B 2*h 2*w"]:
    """Twice the size: each of the four new pixels of one is a mean of its 3 x 3 neighbours, zero beyond the edges.

    Examples:
        >>> upsampled(torch.ones(1, 3, 3), torch.zeros(1, 36, 3, 3))[0, 2:4, 2:4]  # equal weights, all inside
        tensor([[1., 1.],
                [1., 1.]])
    """
    rows, columns = index.shape[-2:]
    convex = weights.unflatten(1, (9, 4)).softmax(1)
    neighbours = F.unfold(index.unsqueeze(1), 3, padding=1).unflatten(-1, (rows, columns)).unsqueeze(2)
    return F.pixel_shuffle((convex * neighbours).sum(1), 2).squeeze(1)


register_network("romnistereo", RomniStereo)
