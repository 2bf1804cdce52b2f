# SPDX-License-Identifier: Apache-2.0
"""Warnings about a capture, and the photo-consistency of its depth: both without ground truth, from the images."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.checks import PLAUSIBLE
from sphericalvision.capture.result import Depth
from sphericalvision.icosphere import Icosphere
from sphericalvision.icosphere.topology import check_level
from sphericalvision.sphere.intake import Intake
from sphericalvision.sweep import photo_consistency_share, semi_global_sweep, semi_global_tables

LEVEL, HYPOTHESES = 5, 24
"""Of the quick sweeps that compare poses."""
ENOUGH_SEEN = 0.9
FAR, SURE = 4.0, 0.5
"""How many times the nearest depth the nearest surface may be away; the confidence from which an answer counts."""
DARK = 0.12
"""Of white: 12 bits in 16 are up to a sixteenth."""
JUDGED_WITH = 16
"""Hypotheses that depth maps are judged with."""
CLEARLY = 1.25
"""How much better the images must agree with the inverse poses."""
DISAGREES = 0.4
"""Correlation of a camera's image with the others' below which it shows something else. Rendered scenes of five kinds
have 0.65 to 0.97 and real captures 0.89 to 0.99; a camera that is mirrored, exchanged or turned has -0.4 to 0.31."""
ELSEWHERE, ALIKE = 0.98, 0.1
"""Cosine of the angle between two cameras; how much less pictures differ than each varies, if they are one."""
COMPARED = 64
"""Pixels of the shorter side of the images that are compared: finer, textures that depth blurs decide."""
FEWEST = 40
"""Directions in which a camera and another one look, below which they are not compared."""


def capture_warnings(depth: Depth) -> list[str]:
    """Return sentences about a frame that say what is probably wrong and what to do; none where all is well.

    They are about how much of the sphere two cameras see, how dark the images are, how many hypotheses lie nearer than
    anything, whether a camera shows something else than the others, or the same, and whether the images agree better
    when the poses are taken the other way round, as camera-from-world.

    Args:
        depth: of one frame.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> from sphericalvision.capture import Predictor
        >>> rig = ring_rig(4, image_size=(64, 64)).subset([0, 2])  # they look away from each other
        >>> predictor = Predictor(rig, method="semi_global", level=4, min_depth=0.5)
        >>> len(capture_warnings(predictor(render_rig(make_scene("room", seed=1), rig))))
        1
    """
    checks = overlap_warning, exposure_warning, hypotheses_warning, poses_warning, disagreement_warning
    return [sentence for check in (*checks, copies_warning) if (sentence := check(depth)) is not None]


def overlap_warning(depth: Depth) -> str | None:
    """Return what to say if two cameras see little of the sphere."""
    if depth.share_seen >= ENOUGH_SEEN:
        return None
    return (
        f"Two cameras see {100 * depth.share_seen:.0f} % of all directions at the depth estimated; elsewhere depth is "
        "a guess: grey in pictures, left out of clouds. If the cameras overlap more than that, their fields of view "
        "(max_angle) or masks are too narrow."
    )


def hypotheses_warning(depth: Depth) -> str | None:
    """Return what to say if most hypotheses lie nearer than anything that was found, or if the rig's size is why."""
    radius = float(depth.rig.radius)
    if len(depth.rig) > 1 and not PLAUSIBLE[0] <= radius <= PLAUSIBLE[1]:
        return (
            f"The cameras are {radius:.3g} m from their centre on average, which is implausible for a rig (expected "
            "5 mm to 5 m), and depth is as wrong; positions are in metres."
        )
    counted = depth.seen & (depth.confidence > SURE)
    if counted.float().mean() < 0.2:
        return None
    nearest = float(depth.depth[counted].float().quantile(0.01))
    if nearest <= FAR * depth.min_depth:
        return None
    return (
        f"Nothing is nearer than about {nearest:.2f} m: {100 * (1 - depth.min_depth / nearest):.0f} % of the "
        f"hypotheses are wasted between that and min_depth = {depth.min_depth:.2f} m. Set min_depth=scene to choose it "
        "from the images."
    )


def exposure_warning(depth: Depth) -> str | None:
    """Return what to say if all images use a small part of the range of their values."""
    brightest = max(float(image.float().flatten()[::97].quantile(0.99)) for image in depth.images.values())
    if brightest >= DARK:
        return None
    return (
        f"The images are dark: nearly all values are below {brightest:.3f} of white, where depth is less exact. "
        "Of 12 bits that are stored in 16, multiply the values by 16; otherwise expose longer."
    )


def poses_warning(depth: Depth) -> str | None:
    """Return what to say if the images agree better with the poses taken as camera-from-world."""
    inverse = depth.rig.replaced(world_from_camera=depth.rig.camera_from_world)
    # Poses of a ring that looks outwards are all in one place when inverted: then they are right as they are.
    if min(float(depth.rig.radius), float(inverse.radius)) < 1e-6:
        return None
    agreement, other = (pose_agreement(depth.images, rig) for rig in (depth.rig, inverse))
    if other <= CLEARLY * agreement + 0.02:
        return None
    return (
        f"The images agree better ({other:.2f} instead of {agreement:.2f} of 1) when the poses are inverted: the "
        "calibration seems to hold camera-from-world where world-from-camera is expected. "
        "CameraRig(rig.cameras, rig.camera_from_world) is the other way round."
    )


@torch.inference_mode()
def pose_agreement(images: Mapping[str, Float[Tensor, "3 _ _"]], rig: CameraRig) -> float:
    """Return how well images agree with poses, 0 to 1: the mean confidence of a quick sweep without training.

    Args:
        images: camera name -> ``(3, h, w)`` in [0, 1].
        rig: unbatched, not all cameras in one place.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> rig = ring_rig(3, image_size=(64, 64))
        >>> images = render_rig(make_scene("room", seed=1), rig)
        >>> swapped = images | {"cam1": images["cam2"], "cam2": images["cam1"]}
        >>> pose_agreement(images, rig) > 1.2 * pose_agreement(swapped, rig)
        True
    """
    intake = Intake(rig, Icosphere(LEVEL))
    nearest = 1.2 * float((rig.positions - rig.center).norm(dim=-1).max())
    estimate = semi_global_sweep(
        intake(images)[None], rig, HYPOTHESES, nearest, level=LEVEL - 1, substeps=1, seen=intake.seen
    )
    return float((estimate.confidence * estimate.seen).sum() / estimate.seen.sum().clamp(min=1))


def copies_warning(depth: Depth) -> str | None:
    """Return what to say if cameras that look elsewhere show one picture, in the middle of their images."""
    axes = depth.rig.world_from_camera[:, :3, 2]
    views = [F.adaptive_avg_pool2d(depth.images[name].float(), 32)[:, 8:24, 8:24] for name in depth.rig.names]
    for k, n in itertools.combinations(range(len(views)), 2):
        if axes[k] @ axes[n] < ELSEWHERE and (views[k] - views[n]).std() < ALIKE * views[k].std():
            return (
                f"The images of {depth.rig.names[k]} and {depth.rig.names[n]} are one picture, and these cameras look "
                "elsewhere: is a device or a folder given twice? Compare images= and cameras= with the calibration."
            )
    return None


def disagreement_warning(depth: Depth) -> str | None:
    """Return a warning about cameras whose images show something else than those of the others."""
    agreement = camera_agreement(depth)
    wrong = [name for name, value in agreement.items() if value < DISAGREES]
    if not wrong:
        return None
    values = ", ".join(f"{name} {value:.2f}" for name, value in agreement.items())
    return (
        f"Images do not show what the others show there: {', '.join(wrong)} "
        f"(correlation {values}; usual are 0.7 and more). Cameras may be exchanged, mirrored, turned, covered, of "
        "another moment, or dark beyond max_angle: compare images= and cameras= with the calibration."
    )


@torch.inference_mode()
def camera_agreement(depth: Depth) -> dict[str, float]:
    """Return the correlation of each camera's image with the mean of the others, at the depth estimated.

    It does not depend on exposure. Cameras without an overlap are left out; one whose image is of one value has 0.

    Args:
        depth: of one frame, with its images.
    """
    directions = Icosphere(LEVEL).vertices.to(depth.index.device)
    inverse_depth = depth.at(directions)[0].nan_to_num(0.0).clamp(min=1e-4)
    points = depth.rig.center.to(directions) + directions / inverse_depth[:, None]
    pixels, valid = depth.rig.project(points)
    values = []
    for k, (name, image) in enumerate((name, depth.images[name]) for name in depth.rig.names):
        grey = image.float().mean(-3, keepdim=True)
        small = F.avg_pool2d(grey, max(1, min(grey.shape[-2:]) // COMPARED), ceil_mode=True)
        sizes = pixels.new_tensor(grey.shape[:-3:-1])
        grid = (2 * (pixels[k] + 0.5) / sizes - 1)[None, None]
        values.append(F.grid_sample(small[None], grid, padding_mode="border", align_corners=False).flatten())
        if name in depth.rig.masks:
            mask = depth.rig.masks[name].to(grey)[None, None]
            valid[k] &= F.grid_sample(mask, grid, mode="nearest", align_corners=False).flatten() > 0.5
    grey, shows = torch.stack(values), valid.to(torch.float32)
    others = shows.sum(0) - shows
    means = ((grey * shows).sum(0) - grey * shows) / others.clamp(min=1)
    result = {}
    for name, own, mean, mask in zip(depth.rig.names, grey, means, valid & (others > 0), strict=True):
        if int(mask.sum()) >= FEWEST:
            pairs = torch.stack((own[mask], mean[mask]))
            pairs = pairs - pairs.mean(1, keepdim=True)
            product = pairs.square().sum(1).prod().sqrt()
            result[name] = float(pairs.prod(0).sum() / product) if product > 1e-6 else 0.0
    return result


class PhotoConsistency:
    """How far the images of a rig agree at a depth map, as a share of what they could: ``photo_consistency_share``.

    What follows from the rig is made at the first call and kept. Depth of any network is judged with the same images
    and hypotheses, so methods may be compared.

    Args:
        level: icosphere level of the images; cameras are compared one level coarser.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.scenes import make_scene, render_rig
        >>> from sphericalvision.capture import Predictor
        >>> predictor = Predictor(ring_rig(4, image_size=(64, 64)), method="semi_global", level=4, min_depth=0.55)
        >>> 0.5 < PhotoConsistency()(predictor(render_rig(make_scene("room", seed=1), predictor.rig))) < 1
        True
    """

    def __init__(self, level: int = 6) -> None:
        self.level = check_level(level)
        self._made_for: tuple[CameraRig, float] | None = None

    @torch.inference_mode()
    def __call__(self, depth: Depth) -> float:
        """Return the share of one frame, 0 to 1.

        Args:
            depth: of one frame, with its images.
        """
        rig, near = depth.rig, depth.min_depth
        if self._made_for is None or self._made_for[0] is not rig or self._made_for[1] != near:
            self._intake = Intake(rig, Icosphere(self.level))
            self._tables = semi_global_tables(rig, JUDGED_WITH, near, self.level)
            self._made_for = rig, near
        index, _ = depth.network.index_at(depth.index[None].float(), Icosphere(self.level - 1).vertices)
        index = index * ((JUDGED_WITH - 1) / (depth.network.num_hypotheses - 1))
        images, seen = self._intake(depth.images)[None], self._intake.seen
        return float(photo_consistency_share(index, images, self._tables, JUDGED_WITH, near, seen))
