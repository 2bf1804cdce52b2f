# SPDX-License-Identifier: Apache-2.0
"""``Hint``: depth that is known beforehand, as people have it, made into what a network takes."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras import CameraRig
from sphericalvision.cameras.checks import check_rigid
from sphericalvision.capture.result import Depth
from sphericalvision.core import ArgumentError, ShapeError, check_choice, check_tensor, check_type
from sphericalvision.geometry.surfaces import distance_along
from sphericalvision.icosphere import Icosphere
from sphericalvision.shapes import check_shapes
from sphericalvision.sweep import DepthHint, index_from_inverse_depth
from sphericalvision.sweep.ring_mean import vertex_rings

if TYPE_CHECKING:
    from sphericalvision.capture.predictor import Predictor
    from sphericalvision.sphere.resampling.views import Views

FITS = ("metres", "scale", "affine")
FARTHEST = 200.0
"""Metres, beyond which a hint says nothing that the images of a rig do."""
COMPARED = 2000
"""Rays of a view that are compared with a network's own answer."""
FEWEST = 20
"""Of them, that meet its surface, below which a view cannot be fitted."""
ROUNDS = 10
"""Of fitting, each with less weight for what is far off."""
MOST_REST = 0.3
"""Of the median inverse depth, the median deviation beyond which a view does not agree."""
SURE = 0.8
"""Confidence from which the depth of a frame alone outweighs that of the frame before."""
SAME_SURFACE = 0.8
"""Of the nearest inverse depth at a vertex, above which points lie on the same surface."""
FORGETTING = 0.9
"""Share of the information of earlier frames that the next one keeps."""
OUTVOTED = 2.0
"""Information of earlier frames, of an unsure answer's, with which they stay once if it contradicts them."""
SURPRISE, OUTLIER = 1.75, 4.0
"""Expected deviations up to which two frames show the same surface: in the mean of directions around, and in one."""


class HintView(NamedTuple):
    """What one camera, one scanner or one panorama says.

    Attributes:
        start: ``(3,)`` of the rays, in the world of the rig; None for the rig's centre.
        rays: ``(P, 3)`` unit directions in the world.
        values: ``(P,)`` inverse depth, in the view's own unit.
        factor: ``(P,)`` by which they are multiplied to be along the rays: cosines, where they are along an axis.
        weight: ``(P,)`` above 0, to 1.
    """

    start: Float[Tensor, " 3"] | None
    rays: Float[Tensor, "P 3"]
    values: Float[Tensor, " P"]
    factor: Float[Tensor, " P"]
    weight: Float[Tensor, " P"]


@dataclass(frozen=True, eq=False)
class Hint:
    """Depth of some directions that is known before a network sees the images.

    It may be sparse, blurred or partly wrong; the network weighs it against what the images show. A predictor takes it
    at the vertices of its network: ``predictor(images, hint.on(predictor.grid, predictor.rig))``.

    Args:
        views: of ``of_points``, ``of_directions`` or ``of_views``.
        fit: ``"metres"``: as it is. ``"scale"``: each view is multiplied so that it agrees with the network's own
            answer without a hint, which is computed first. ``"affine"``: its inverse depth is multiplied and shifted,
            as monocular networks with relative inverse depth want it.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> hint = Hint.of_points(torch.tensor([[0.0, 0.0, 2.0], [4.0, 0.0, 0.0]]))
        >>> inverse_depth, weight = hint.on(Icosphere(3), ring_rig(4))
        >>> weight.sum(), inverse_depth[weight > 0]
        (tensor(2.), tensor([0.5000, 0.2500]))
    """

    views: Sequence[HintView]
    fit: Literal["metres", "scale", "affine"] = "metres"

    def __post_init__(self) -> None:
        check_choice("fit", self.fit, FITS)
        if not any(len(view.values) and bool((view.values != 0).any()) for view in self.views):
            raise ArgumentError(
                "hint: it has no valid depth: all values are 0, infinite or NaN, or have the weight 0; leave it out"
            )
        nearest = max(float(view.values.max()) for view in self.views if len(view.values))
        if self.fit == "metres" and 0 < nearest < 1 / FARTHEST:
            raise ArgumentError(
                f"hint: expected metres from the rig, got nothing nearer than {1 / nearest:,.0f} m; divide "
                "millimetres by 1000, or take the rig's position away from the coordinates of a map"
            )
        for view in self.views:
            below = 0 if self.fit == "affine" else int((view.values < 0).sum())
            if below:
                raise ArgumentError(
                    f"hint: expected depth above 0, or 0 where it is unknown, got {below} negative numbers"
                )

    @classmethod
    @check_shapes
    def of_points(
        cls,
        points: Float[Tensor, "P 3"],
        weight: float | Float[Tensor, " P"] = 1.0,
        fit: Literal["metres", "scale"] = "metres",
    ) -> Hint:
        """Points ``(P, 3)`` in the frame of the rig's calibration, as a LiDAR beside it has them.

        Those that are not finite are left out. In ``"scale"`` they are counted from the rig's centre.
        """
        check_choice("fit", fit, ("metres", "scale"))
        origin = None if fit == "scale" else points.new_zeros(3)
        distance = points.norm(dim=-1)
        return cls([_view(origin, points, 1 / distance, None, weight, distance > 0)], fit)

    @classmethod
    @check_shapes
    def of_directions(
        cls,
        directions: Float[Tensor, "*shape 3"],
        inverse_depth: Float[Tensor, "*shape"],
        weight: float | Float[Tensor, "*shape"] = 1.0,
        fit: Literal["metres", "scale", "affine"] = "metres",
    ) -> Hint:
        """Inverse depth ``(*)`` in 1/m, 0 at infinity, in directions ``(*, 3)`` of the world from the rig's centre.

        A panorama is ``of_directions(Equirectangular(h, 2 * h).directions, 1 / depth)``. NaN is unknown.
        """
        return cls([_view(None, directions.reshape(-1, 3), inverse_depth.flatten(), None, weight)], fit)

    @classmethod
    def of_views(
        cls,
        views: Views,
        quantity: Literal["range", "z"] = "range",
        fit: Literal["metres", "scale", "affine"] = "metres",
        weight: float = 1.0,
    ) -> Hint:
        """Depth images of cameras: ``Views(depths, rig)``, or ``views(photographs, rig).map(network)``.

        Cameras that all stand at the origin are taken to stand at the rig's centre, as those that ``views`` cuts.

        Args:
            views: with one channel; 0, infinity and NaN are unknown. With ``"affine"`` they hold inverse depth, of
                which 0 is infinity.
            quantity: ``"range"`` along each pixel's ray, or ``"z"`` along each camera's axis.
            fit: see the class.
            weight: of all pixels.
        """
        from sphericalvision.sphere.resampling.views import Views

        check_type("views", views, Views, "Views(depth images, rig), or views(...).map(network)")
        check_choice("quantity", quantity, ("range", "z"))
        chunks = []
        at_center = bool((views.rig.positions == 0).all())
        for number, (name, camera) in enumerate(views.rig.cameras.items()):
            image = views.images[number]
            if image.numel() != image.shape[-1] * image.shape[-2]:
                raise ShapeError(f"views: expected depth (1, h, w) of {name}, got {tuple(image.shape)}")
            rays, seen = camera.to(image.device).unproject(camera.pixel_grid(torch.float32).to(image.device))
            mask = views.rig.masks.get(name)
            usable = seen if mask is None else seen & mask.to(seen.device)
            pose = views.rig.world_from_camera[number].to(image.device, torch.float32)
            factor = rays[..., 2].flatten() if quantity == "z" else None
            values = image.flatten().float()
            if fit != "affine":
                values = inverse_of(values)
            usable = usable.flatten() & ((rays[..., 2].flatten() > 1e-3) | (quantity == "range"))
            start = None if at_center else pose[:3, 3]
            chunks.append(_view(start, rays.reshape(-1, 3) @ pose[:3, :3].T, values, factor, weight, usable))
        return cls(chunks, fit)

    @classmethod
    def of_depth(cls, depth: Depth, pose: Float[Tensor, "4 4"]) -> CarriedDepth:
        """The depth of the frame before, carried on by the motion of the rig: see ``CarriedDepth``.

        Args:
            depth: of one frame.
            pose: ``(4, 4)`` from the world of its rig to that of the rig now, whatever the ``origin`` of each. The
                identity where rigs move in one world, as those of ``poses=`` do.
        """
        return CarriedDepth(depth, pose)

    def on(self, grid: Icosphere, rig: CameraRig, answer: Depth | None = None) -> DepthHint:
        """Return what is known at an icosphere's vertices ``(1, V)``, from the rig's centre.

        Args:
            grid: of the network.
            rig: in whose world the views are.
            answer: ``predictor(images)``, the depth without a hint; only where there is something to ``fit``.

        Raises:
            ArgumentError: no view can be fitted, as none looks where the answer's surface is.
        """
        device = grid.vertices.device
        directions, inverse, weights = [], [], []
        center = rig.center.to(device, torch.float32)
        for number, view in enumerate(self.views):
            rays, values, factor, weight = (part.to(device) for part in view[1:])
            offset = torch.zeros_like(center) if view.start is None else view.start.to(center) - center
            if self.fit != "metres":
                if answer is None:
                    raise ArgumentError(f"answer: expected that of the network, to which fit={self.fit} fits")
                fitted = self._fitted(HintView(offset, rays, values, factor, weight), answer)
                if fitted is None:
                    warnings.warn(
                        f"hint: view {number + 1} of {len(self.views)} is left out, since no {self.fit} makes it agree "
                        "with the network's own depth; is it of another frame?",
                        stacklevel=4,
                    )
                    continue
                values = fitted
            along = (factor * values).clamp(min=1e-6)  # infinity is far
            points = offset + rays / along[:, None]
            distance = points.norm(dim=-1).clamp(min=1e-6)
            directions.append(points / distance[:, None])
            inverse.append(1 / distance)
            weights.append(weight)
        if not directions:
            raise ArgumentError(
                "hint: no view of it agrees with the network's own depth; give one of this frame, or fit=metres"
            )
        return _at_vertices(grid, torch.cat(directions), torch.cat(inverse), torch.cat(weights))

    def _fitted(self, view: HintView, answer: Depth) -> Tensor | None:
        """The values of a view, scaled and with ``"affine"`` shifted to the answer's; None if they do not agree."""
        every = max(1, len(view.values) // COMPARED)
        rays, values, factor = (part[::every].float() for part in (view.rays, view.values, view.factor))
        assert view.start is not None
        distance = distance_along(rays, view.start, lambda d: answer.at(d)[0], answer.min_depth)
        met = distance.isfinite()
        target = (1 / (distance * factor))[met]
        where = F.normalize(view.start + distance[met, None] * rays[met], dim=-1)
        sure = answer.at(where)[1] + 1e-3
        values = values[met]
        if len(values) < FEWEST:
            return None
        columns = [values, torch.ones_like(values)] if self.fit == "affine" else [values]
        matrix = torch.stack(columns, 1).double()
        trust = sure.double()
        for _ in range(ROUNDS):
            weighted = matrix * trust[:, None]
            change = torch.linalg.lstsq(weighted.mT @ matrix, weighted.mT @ target.double()).solution
            rest = (matrix @ change - target).abs()
            trust = sure / (1 + (rest / rest.median().clamp(min=1e-6)).square())
        if not change[0] > 0 or rest.median() > MOST_REST * target.median():
            return None
        return change[0].float() * view.values + (change[1].float() if self.fit == "affine" else 0)


@dataclass(frozen=True, eq=False)
class CarriedDepth:
    """The depth of the frame before, which is averaged with what a network says of the next: a recursive filter.

    The network does not see it, so any network may be steadied. Each of the two counts by its information, ``1 / σ²``
    by the confidence, and what is carried on fades from frame to frame. Where the two differ by more than both are
    expected to be off, over several directions, something moved or was hidden, and the frame before is forgotten: at
    once if the network is sure, and otherwise when two frames have contradicted.

    Args:
        depth: of one frame.
        pose: ``(4, 4)`` from the world of its rig to that of the rig now.

    Examples:
        >>> from sphericalvision.cameras import ring_rig
        >>> from sphericalvision.capture import Depth
        >>> from sphericalvision.models import WinnerTakesAll
        >>> net, rig, ones = WinnerTakesAll(3, 16, depth_coarsening=0), ring_rig(3), torch.ones(642)
        >>> first, second = (Depth(index * ones, ones, ones > 0, net, rig, {}) for index in (6.1, 6.0))
        >>> CarriedDepth(first, torch.eye(4)).averaged(second).index.mean()
        tensor(6.0474)
    """

    depth: Depth
    pose: Float[Tensor, "4 4"]

    def __post_init__(self) -> None:
        _check_one_frame(self.depth)
        pose = torch.as_tensor(self.pose)
        if pose.shape != (4, 4):
            raise ShapeError(f"pose: expected shape (4, 4), got {tuple(pose.shape)}")
        check_rigid("pose", pose.double())

    def averaged(self, depth: Depth) -> Depth:
        """Return the depth of the frame now, averaged with the one before; confidence and ``seen`` as they are."""
        _check_one_frame(depth)
        before, rays = self.depth, depth.directions.reshape(-1, 3)
        pose = self._from_now(depth).to(rays)
        now, own = depth.inverse_depth.flatten().float(), depth.information.flatten()
        points = (rays / now[:, None] + depth.rig.center.to(rays)) @ pose[:3, :3].T + pose[:3, 3]
        points = points - before.rig.center.to(points)
        distance = points.norm(dim=-1).clamp(min=1e-6)
        # Looked up where the point of now is: the surface there is as much nearer or farther along both rays.
        values = torch.stack((before.inverse_depth, before.information)).to(torch.float32)
        (carried, weight), reached = before.network.index_at(values, points / distance[:, None])
        carried, weight = carried * now * distance, FORGETTING * weight
        expected = (1 / own + 1 / weight.clamp(min=1e-9)).sqrt()
        alone = ((now - carried) / expected).where(reached, OUTLIER).clamp(-OUTLIER, OUTLIER)
        surprise, grid = alone, depth.network.grid
        # What moves is seen in directions side by side, what flickers less so
        if isinstance(grid, Icosphere):
            rings = vertex_rings(grid.level, alone.device)
            for _ in range(2):
                surprise = surprise[rings].mean(1)
        same = (alone.abs() < OUTLIER) & (surprise.abs() <= SURPRISE) & (depth.index.flatten() > 0)
        # Most of what is unsure and contradicts is a guess that the next frame does not repeat. What is left of earlier
        # frames is less than they need to stay once more.
        unsure = (depth.confidence.flatten() < SURE) & reached & (depth.index.flatten() > 0)
        stays = ~same & unsure & (weight > OUTVOTED * own)
        weight = weight.where(same, OUTVOTED * own * stays)
        own = own.where(~stays, 0.0)
        carries, total = same | stays, own + weight
        mean = (own * now + weight * carried.where(carries, 0.0)) / total
        number = depth.network.num_hypotheses
        index = index_from_inverse_depth(mean, number, depth.min_depth).clamp(max=number - 1)
        index = index.to(depth.index).where(carries, depth.index.flatten())
        return replace(depth, index=index.view_as(depth.index), accumulated=total.view_as(depth.index))

    def _from_now(self, depth: Depth) -> Tensor:
        """``(4, 4)`` from where the rig's positions now are counted from to where those before are."""
        now, before = depth.rig.origin, self.depth.rig.origin
        pose = torch.linalg.inv(torch.as_tensor(self.pose).to(now))  # float64: worlds may be far away
        pose[:3, 3] += pose[:3, :3] @ now - before.to(now)
        return pose


def _check_one_frame(depth: Depth) -> None:
    check_type("depth", depth, Depth, "a Predictor returns one")
    if depth.batch_shape:
        raise ArgumentError("depth: expected that of one frame; take one of the batch with depth.select(i)")


def inverse_of(depth: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return inverse depth, NaN where depth is 0 or infinite: sensors say so where they measured nothing."""
    return 1 / depth.where((depth != 0) & depth.isfinite(), torch.nan)


def with_hint(predictor: Predictor, images: Mapping[str, Any], hint: Hint) -> Depth:
    """Return the depth of a frame with a hint, which is fitted to the depth without it where it has to be.

    Args:
        predictor: whose network takes hints.
        images: of one frame, as the predictor takes them.
        hint: of the same frame.

    Raises:
        ArgumentError: the network takes none, or no part of the hint agrees with the frame.
    """
    predictor.check_takes_hints()
    answer = None if hint.fit == "metres" else predictor(images)
    if answer is not None and answer.batch_shape:
        raise ArgumentError("hint: it is of one frame, got images of a batch; give them one by one")
    assert isinstance(predictor.grid, Icosphere)  # of all networks that take hints
    return predictor(images, hint.on(predictor.grid, predictor.rig, answer))


def _view(
    start: Tensor | None,
    rays: Tensor,
    values: Tensor,
    factor: Tensor | None,
    weight: float | Tensor,
    usable: Tensor | None = None,
) -> HintView:
    """A view of those rays whose value is known and that count."""
    rays, values = rays.detach().float(), values.detach().float()
    if not isinstance(weight, Real):
        check_tensor("weight", weight, "a number, or one for each value")
    weights = torch.as_tensor(weight, dtype=torch.float32, device=values.device)
    weights = weights.flatten().expand(values.shape)
    if bool(((weights < 0) | (weights > 1)).any()):
        raise ArgumentError(
            f"weight: expected 0 to 1, got {weights.min().item():g} to {weights.max().item():g}"
        )
    valid = values.isfinite() & rays.isfinite().all(-1) & (rays != 0).any(-1) & (weights > 0)
    if usable is not None:
        valid &= usable
    factor = torch.ones_like(values) if factor is None else factor
    return HintView(start, F.normalize(rays[valid], dim=-1), values[valid], factor[valid], weights[valid])


def _at_vertices(grid: Icosphere, directions: Tensor, inverse: Tensor, weight: Tensor) -> DepthHint:
    """What points say at the vertices nearest to them: the mean of those on the nearest surface."""
    vertex = grid.nearest(directions)
    zeros = inverse.new_zeros(grid.num_vertices)
    front = zeros.scatter_reduce(0, vertex, inverse, "amax")
    weight = weight.where(inverse >= SAME_SURFACE * front[vertex], 0.0)
    total = zeros.index_add(0, vertex, weight)
    mean = zeros.index_add(0, vertex, weight * inverse) / total.clamp(min=1e-6)
    return DepthHint(mean[None], zeros.scatter_reduce(0, vertex, weight, "amax")[None])
