# SPDX-License-Identifier: Apache-2.0
"""The body that carries a rig, found in its images: what stands still in all of them while the rig moves.

A pixel that changes little proves nothing: so do the sky and white walls. Edges do: a vehicle's outline has the same
gradient in every frame, that of anything else only now and then. From such edges the body is grown as far as the
gradients of all frames agree. Edges of far things stay, too, while a rig turns little: two cameras see them in the same
direction, the body not.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from sphericalvision.cameras.base import check_single
from sphericalvision.cameras.rig import CameraRig, check_images_of
from sphericalvision.core import ArgumentError

Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

FEWEST, MOST = 8, 50
"""Different views that are needed, and frames that are kept."""
ROWS = 192
"""Of the images that are kept: the outline of a body is found to about half a percent of the image."""
CHANGED = 0.02
"""Difference of values by which a pixel has changed."""
OTHER_VIEW, OTHER_PLACE, FEWEST_PLACES = 0.05, 0.5, 6
"""Share of changed pixels in another view and in another place, and how many of these are needed."""
MEAN_VALUE = 0.45
"""To which the median of each frame is brought."""
FINE, BROAD, SMOOTH = 1.0, 4.0, 2.0
"""Standard deviations in pixels: edges are what is between the first two; change is looked for in smoother images."""
WEAKEST, SOFTENING = 0.008, 0.003
"""Gradients per pixel: the least of an edge, and what is added where their share is taken."""
BESIDE = 0.35
"""Share of the strongest gradient within five pixels that an edge has."""
CHANGE, NOISE_CHANGE = 0.0012, 1.8
"""Gradients of a pixel that moves deviate by the first and this many times what noise alone makes of them."""
SHORTEST = 0.08
"""Of a chain of edges, in diameters of the field of view; in such a square, some of a part are covered."""
SMALLEST = 0.02
"""Share of the field of view: a smaller part of the surroundings belongs to the body that is around it."""
STILL_SHARE = 0.1
"""Of a part of the body that is inside, away from its edges. A horizon has no inside that stands still."""
DISTANCES = (10.0, 30.0, 1000.0)
"""Where what is no part of a rig is looked for, in radii of the rig."""
FAR_RADIUS, FAR_LIKENESS = 5, 0.8
"""Neighbourhood in pixels, and correlation, at which two cameras show the same far thing."""
TOO_MUCH = 0.4
"""Share of all pictures above which it is the rig that stands still."""


class OwnBody(NamedTuple):
    """What of a rig's images is free of the rig's own body.

    Attributes:
        masks: camera name -> ``(h, w)``, True where the image is usable, as ``CameraRig`` takes it; masks that the rig
            had before are part of them. True outside of the field of view.
        shares: camera name -> share of the field of view that the body covers.
        num_views: frames that differ from the one before, of those that were kept.
        reason: why nothing was found; empty if something was.

    Examples:
        >>> found = OwnBody({"cam1": torch.ones(8, 8, dtype=torch.bool)}, {"cam1": 0.0}, 1, "1 view(s), 8 are needed")
        >>> max(found.shares.values()), found.reason
        (0.0, '1 view(s), 8 are needed')
    """

    masks: dict[str, Bool[Tensor, "_ _"]]
    shares: dict[str, float]
    num_views: int
    reason: str

    def described(self) -> list[str]:
        """Return a line for each camera."""
        why = f" ({self.reason or 'no body was seen'})"
        return [
            f"mask of {name}: {100 * share:.1f} % of its picture{'' if share else why}"
            for name, share in self.shares.items()
        ]


def find_own_body(
    rig: CameraRig, frames: Iterable[Mapping[str, Float[Tensor, "c _ _"]]], margin: int = 1
) -> OwnBody:
    """Find the body that carries a rig in images that were taken while it moved.

    Eight different views are the least; fifty from a whole recording with turns in it are good. Nothing is found if the
    rig moved too little to tell. Parts of the body that move are not found.

    Args:
        rig: a single rig. Pixels that its masks hide are not looked at.
        frames: of each the images, camera name -> ``(c, h, w)`` in [0, 1]. A generator may read them one by one: small
            grey images of at most fifty frames are kept, spread evenly over all that come.
        margin: around the body, in pixels of images of 192 rows.

    Raises:
        ArgumentError: images are not those of the rig's cameras, or a negative margin.
        ShapeError: an image has another size than its camera.

    References:
        Dekel et al. (2017), "On the effectiveness of visible watermarks", for the median of gradients; Grady (2006),
        "Random walks for image segmentation".

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> rig = ring_rig(2, image_size=(64, 64))
        >>> found = find_own_body(rig, [dict.fromkeys(rig.names, torch.rand(3, 64, 64)) for _ in range(4)])
        >>> found.reason
        '4 different view(s) of 4 frame(s), at least 8 are needed: the rig must move'
    """
    check_single(rig)
    if margin < 0:
        raise ArgumentError(f"margin: expected 0 or more pixels, got {margin}")
    small = rig.resized({name: _small_size(camera.image_size) for name, camera in rig.cameras.items()})
    cameras = {name: _CameraEdges(small, name) for name in rig.names}
    samples = _samples(rig, cameras, frames)
    views = _different(samples, cameras, OTHER_VIEW)
    if len(views) < FEWEST:
        number = f"{len(views)} different view(s) of {len(samples)} frame(s), at least {FEWEST} are needed"
        return _nothing(rig, len(views), f"{number}: the rig must move")
    num_positions = len(_different(samples, cameras, OTHER_PLACE))
    if num_positions < FEWEST_PLACES:
        number = (
            f"half of the images changed {num_positions - 1} time(s), at least {FEWEST_PLACES - 1} are needed"
        )
        return _nothing(rig, len(views), f"{number}: the rig must move farther, and turn")
    for name, view in cameras.items():
        view.look(np.stack([images[name] for images in views]))
    edges = {name: view.edges & ~_far(small, cameras, name) for name, view in cameras.items()}
    bodies = {name: view.grown(edges[name], margin) for name, view in cameras.items()}
    seen = sum(int(view.seen.sum()) for view in cameras.values())
    covered = sum(int(body.sum()) for body in bodies.values())
    if covered > TOO_MUCH * seen:
        number = f"{100 * covered / seen:.0f} % of the images stand still"
        return _nothing(rig, len(views), f"{number}: the rig must move farther, and turn")
    masks, fractions = {}, {}
    for name, body in bodies.items():
        size = rig.cameras[name].image_size
        large = F.interpolate(torch.from_numpy(body)[None, None].float(), size, mode="bilinear")[0, 0] > 0.5
        free = (~large).to(rig.world_from_camera.device)
        masks[name] = free & rig.masks[name] if name in rig.masks else free
        fractions[name] = float(body.sum() / max(1, cameras[name].seen.sum()))
    return OwnBody(masks, fractions, len(views), "" if covered else "no body was seen")


class _CameraEdges:
    """One camera, in the small size; after ``look`` its edges that stand still, and where things move."""

    median: Floats
    edges: Bools
    moving: Bools

    def __init__(self, rig: CameraRig, name: str) -> None:
        camera = rig.cameras[name]
        seen = camera.unproject(camera.pixel_grid()).valid
        if name in rig.masks:
            seen = seen & rig.masks[name].bool()
        self.seen: Bools = seen.cpu().numpy()
        self.size = camera.image_size
        self.diameter = math.sqrt(4 / math.pi * int(self.seen.sum()))
        # Pixels at the rim are half black; they get the values of the nearest that are not.
        self.inside = _eroded(self.seen, 2)

    def grey(self, image: Tensor) -> Floats:
        """A small grey image, its border continued beyond the field of view, its median brought to one value."""
        grey = image.detach().float().mean(0).cpu()
        small = cv2.resize(grey.numpy(), self.size[::-1], interpolation=cv2.INTER_AREA)
        resized: Floats = small.astype(np.float32)
        if not self.inside.any():
            return resized
        median = max(float(np.median(resized[self.inside])), 0.05)
        return self.continued(resized) * np.float32(MEAN_VALUE / median)

    def continued(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values of the nearest pixels inside, where a pixel is not."""
        source = (~self.inside).astype(np.uint8)
        _, labels = cv2.distanceTransformWithLabels(source, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        table = np.zeros(int(labels.max()) + 1, values.dtype)
        table[labels[self.inside]] = values[self.inside]
        return table[labels]

    def look(self, frames: Floats) -> None:
        """Find what stands still, and what moves, in frames ``(n, h, w)``."""
        self.median = np.median(frames, 0)
        if not self.inside.any():
            self.edges = self.moving = np.zeros_like(self.seen)
            return
        fine = [cv2.GaussianBlur(f, (0, 0), FINE) - cv2.GaussianBlur(f, (0, 0), BROAD) for f in frames]
        down, across = _gradients(fine)
        # The median of gradients that point anywhere is about 0: frames agree by chance less, the more there are.
        still = np.hypot(np.median(down, 0), np.median(across, 0))
        # Beside a strong edge the broad images have weak ones.
        strong = still > np.maximum(WEAKEST, BESIDE * cv2.dilate(still, np.ones((11, 11), np.uint8)))
        agreement = np.where(self.inside & strong, still / (np.hypot(down, across).mean(0) + SOFTENING), 0)
        sure = 0.45 + 1.2 / math.sqrt(len(frames))
        self.edges = _hysteresis(agreement, sure - 0.15, sure)

        down, across = _gradients([cv2.GaussianBlur(f, (0, 0), SMOOTH) for f in frames])
        deviation = np.hypot(down - np.median(down, 0), across - np.median(across, 0)).mean(0)
        self.moving = cv2.blur(deviation, (5, 5)) > CHANGE + NOISE_CHANGE * self._noise(frames)

    def _noise(self, frames: Floats) -> float:
        """Mean deviation of gradients of smooth images that noise alone would make (Immerkær's estimate of noise)."""
        kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
        medians = [float(np.median(abs(cv2.filter2D(f, cv2.CV_32F, kernel))[self.inside])) for f in frames]
        deviation = 1.4826 / 6 * float(np.median(medians))
        return math.sqrt(math.pi / 2) * deviation / (SMOOTH**2 * math.sqrt(8 * math.pi))

    def grown(self, edges: Bools, margin: int) -> Bools:
        """The body of which these edges are."""
        from skimage.segmentation import random_walker  # a second to import

        nothing = np.zeros_like(self.seen)
        edges = _without_small(edges, SHORTEST * self.diameter)
        area = int(self.inside.sum())
        around = _without_small(self.inside & ~_dilated(edges, 4) & self.moving, SMALLEST * area)
        if not edges.any() or not around.any():
            return nothing
        seeds = np.where(self.inside, 0, -1)
        seeds[around], seeds[edges] = 1, 2
        image = self.median / (float(self.median[self.inside].std()) + 1e-6)
        labels = random_walker(image, seeds, mode="cg_j", tol=1e-2, prob_tol=0.5)
        body = self.inside & (labels == 2)
        surroundings = _without_small(self.inside & ~body, SMALLEST * area, connectivity=4)
        body = self.inside & ~surroundings
        # A part of the body reaches the border of the picture, and is more than its edges.
        count, parts = cv2.connectedComponents(body.astype(np.uint8))
        border = self.inside & ~_eroded(self.inside, 3)
        quiet, beyond = ~self.moving & ~_dilated(edges, 1), self.continued(parts)
        for part in range(1, count):
            region = parts == part
            if not (region & border).any() or (quiet & (beyond == part)).sum() < STILL_SHARE * region.sum():
                body &= ~region
        if not body.any():
            return nothing
        return _dilated(self.continued(body.astype(np.uint8)) > 0, margin) & self.seen


def _far(rig: CameraRig, cameras: Mapping[str, _CameraEdges], name: str) -> Bools:
    """Where another camera shows the same at one of the distances of what is no part of the rig."""
    camera, far = rig.cameras[name], np.zeros(cameras[name].size, bool)
    region, place = cameras[name].median, rig.names.index(name)
    directions = camera.unproject(camera.pixel_grid()).directions
    for other_place, other in enumerate(rig.names):
        if other_place == place:
            continue
        between = rig.camera_from_world[other_place] @ rig.world_from_camera[place]
        for distance in DISTANCES:
            metres = max(distance * float(rig.radius), 1e-6)
            points = directions @ between[:3, :3].mT + between[:3, 3] / metres
            pixels, valid = rig.cameras[other].project(points)
            x, y = pixels.float().cpu().movedim(-1, 0).contiguous().numpy()
            warped: Any = cv2.remap(cameras[other].median, x, y, cv2.INTER_LINEAR)
            inside = cv2.remap(cameras[other].inside.astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
            far |= _eroded(inside & valid.cpu().numpy(), 2) & (_likeness(region, warped) > FAR_LIKENESS)
    return far


def _likeness(one: Floats, other: Floats) -> Floats:
    """Correlation of the neighbourhoods of each pixel, -1 to 1."""

    def mean(values: Floats) -> Floats:
        return np.asarray(cv2.blur(values, (2 * FAR_RADIUS + 1,) * 2))

    first, second = mean(one), mean(other)
    spread: Any = (mean(one * one) - first**2) * (mean(other * other) - second**2)
    likeness: Floats = (mean(one * other) - first * second) / np.sqrt(np.maximum(spread, 1e-10))
    return likeness


def _samples(
    rig: CameraRig, cameras: Mapping[str, _CameraEdges], frames: Iterable[Mapping[str, Tensor]]
) -> list[dict[str, Floats]]:
    """Small grey images of up to ``MOST`` frames: every one, then every second one, every fourth, and so on."""
    samples: list[dict[str, Floats]] = []
    step = 1
    for number, images in enumerate(frames):
        check_images_of(rig, images, "frames", "(c, h, w)")
        if number % step:
            continue
        if len(samples) == MOST:
            samples, step = samples[::2], 2 * step
            if number % step:
                continue
        samples.append({name: view.grey(images[name]) for name, view in cameras.items()})
    return samples


def _different(
    samples: list[dict[str, Floats]], cameras: Mapping[str, _CameraEdges], share: float
) -> list[dict[str, Floats]]:
    """The frames of which such a share of pixels has changed since the last one of them."""
    views: list[dict[str, Floats]] = []
    for images in samples:
        if views:
            changed = [
                (abs(cv2.GaussianBlur(images[name] - views[-1][name], (0, 0), SMOOTH)) > CHANGED)[view.inside]
                for name, view in cameras.items()
            ]
            if np.concatenate(changed).mean() < share:
                continue
        views.append(images)
    return views


def _nothing(rig: CameraRig, num_views: int, reason: str) -> OwnBody:
    """All is usable that was before."""
    device = rig.world_from_camera.device
    everything = {
        name: torch.ones(camera.image_size, dtype=torch.bool, device=device)
        for name, camera in rig.cameras.items()
    }
    return OwnBody({**everything, **rig.masks}, dict.fromkeys(rig.names, 0.0), num_views, reason)


def _small_size(size: tuple[int, int]) -> tuple[int, int]:
    factor = max(1.0, size[0] / ROWS)
    return round(size[0] / factor), max(1, round(size[1] / factor))


def _gradients(images: Iterable[Floats]) -> tuple[Floats, Floats]:
    """Down and across, per pixel (Scharr's)."""
    pairs = [(cv2.Scharr(i, cv2.CV_32F, 0, 1) / 32, cv2.Scharr(i, cv2.CV_32F, 1, 0) / 32) for i in images]
    down, across = zip(*pairs, strict=True)
    return np.stack(down), np.stack(across)


def _hysteresis(values: Floats, low: float, high: float) -> Bools:
    """What is above ``low`` and connected with something above ``high``."""
    count, labels = cv2.connectedComponents((values > low).astype(np.uint8))
    selected = np.zeros(count, bool)
    selected[np.unique(labels[values > high])] = True
    selected[0] = False
    return np.asarray(selected[labels])


def _without_small(parts: Bools, size: float, connectivity: int = 8) -> Bools:
    """Connected parts of at least so many pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(parts.astype(np.uint8), connectivity=connectivity)
    selected = stats[:, cv2.CC_STAT_AREA] >= size
    selected[0] = False
    return np.asarray(selected[labels])


def _dilated(mask: Bools, radius: int) -> Bools:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def _eroded(mask: Bools, radius: int) -> Bools:
    """Pixels that are farther than ``radius`` from any outside of it, which the border of the image is, too."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    pixels = mask.astype(np.uint8)
    return np.asarray(cv2.erode(pixels, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0)
