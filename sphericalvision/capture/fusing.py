# SPDX-License-Identifier: Apache-2.0
"""One cloud of many frames: weighted means in cubes, and which of them the frames agree on."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from sphericalvision.cameras.rig import FAR
from sphericalvision.capture.points import SurfacePoints
from sphericalvision.capture.result import DepthImage
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.io.arrays import read_npz
from sphericalvision.io.files import atomic_write
from sphericalvision.sphere import Equirectangular

FEWEST = 3
"""Frames that have a point in a cube of the cloud."""
FARTHER = 0.05
"""Share of the distance, beside two cubes, by which a frame looks past what it sees through."""
MOST = 8_000_000
"""Cubes, of 56 bytes each; of more the sides are doubled."""
MAX_STATE = 2**30
"""Bytes of the state: of that many cubes, and the names of frames."""
BITS = 21
"""Of a cube's place along an axis, counted from the middle of all places."""
RESTED = 10
"""Share of the time between two writings of the state that a writing takes is one of so many."""
CONFIRMED, THROUGH = 10, 11
"""Columns of ``sums``, behind the weight and what is weighted by it: place in the cube, colour and normal."""


class FusedCloud:
    """Points of frame after frame as one for each cube, the mean by confidence, with what frames say about the cube.

    A frame *confirms* a cube in which it has a point. It *sees through* a cube if the depth that it estimates there,
    the least of neighbouring pixels, is farther than the cube by two sides and 5 %. A cube belongs to the cloud if
    three frames confirm it (all, where there are fewer), and no more see through it. Only frames that come after the
    first that confirms a cube are asked whether they see through it.

    What is kept does not grow with the number of frames, but with the surface they have seen: 56 bytes for each cube,
    and the names of the frames. Beyond eight million cubes their sides are doubled, and where a frame is more than a
    million sides away from the first one.

    Args:
        side: of the cubes, metres.

    Attributes:
        frames: names of those that are in it, in order.
        origin: ``(3,)`` float64, from where cubes are counted: near the first frame, if the world's is far away.

    Examples:
        >>> rays = Equirectangular(32, 64).directions.flatten(0, 1)
        >>> ones = torch.ones(32, 64)
        >>> fused = FusedCloud(0.25)
        >>> for name in ("000", "001"):  # a ball of a metre, seen twice
        ...     points = SurfacePoints(rays, rays.abs(), -rays, ones.flatten())
        ...     fused.add(name, points, DepthImage(ones, ones, ones > 0), torch.zeros(3))
        >>> len(rays), len(fused.points().points) < 400, fused.points().points.norm(dim=-1).min() > 0.9
        (2048, True, tensor(True))
    """

    def __init__(self, side: float) -> None:
        self.side = side
        self.frames: dict[str, None] = {}
        self.origin = torch.zeros(3, dtype=torch.float64)
        self._cubes, self._sums = torch.zeros(0, dtype=torch.int64), torch.zeros(0, 12)
        self._written, self._took = 0.0, 0.0

    def __len__(self) -> int:
        return len(self._cubes)

    def add(
        self,
        frame: str,
        cloud: SurfacePoints,
        panorama: DepthImage,
        center: Float[Tensor, " 3"],
        origin: Float[Tensor, " 3"] | None = None,
    ) -> None:
        """Add the points of a frame, unless it is there already.

        Args:
            frame: its name.
            cloud: its points in the world that all frames have in common.
            panorama: its depth, ``(h, w)``.
            center: ``(3,)``, from where the panorama looks.
            origin: ``(3,)`` float64, from where points and centre are seen, that of the rig; the world's when not
                given.
        """
        if frame in self.frames:
            return
        center = center.cpu().double() + (0 if origin is None else origin.cpu())
        if not center.isfinite().all():
            raise ArgumentError(f"center: expected metres, got {center.tolist()}")
        if not self.frames and center.abs().max() > FAR:
            self.origin = center.round()
        self.frames[frame] = None
        offset = -self.origin if origin is None else origin.cpu() - self.origin
        center = center - self.origin
        while center.abs().max() / self.side >= 2 ** (BITS - 2):
            self._coarsen()
        self._see_through(panorama, center)
        cells = (cloud.points.cpu().double() + offset) / self.side
        cubes = cells.floor().long()
        within = (cubes.abs() < 2 ** (BITS - 1)).all(-1)
        weights = cloud.confidence.cpu().clamp(min=1e-3)[:, None]
        rest = (cells - cubes).float()
        weighted = [weights * values for values in (rest, cloud.colors.cpu(), cloud.normals.cpu())]
        sums = torch.cat((weights, *weighted, torch.zeros(len(weights), 2)), 1)
        packed, sums = _summed(_packed(cubes[within]), sums[within])
        sums[:, CONFIRMED] = 1
        self._cubes, self._sums = _summed(torch.cat((self._cubes, packed)), torch.cat((self._sums, sums)))
        while len(self) > MOST:
            self._coarsen()

    def points(self) -> SurfacePoints:
        """Return the points that frames agree on; their confidence is the share of frames that confirm them.

        That is of those that confirm them or see through them. In a far world points are float64.
        """
        confirmed, through = self._sums[:, CONFIRMED], self._sums[:, THROUGH]
        mask = (confirmed >= min(FEWEST, len(self.frames))) & (through <= confirmed)
        sums, weights = self._sums[mask], self._sums[mask, :1]
        sure = (confirmed / (confirmed + through))[mask]
        points = self._positions()[mask]
        points = points + self.origin if self.origin.any() else points.float()
        return SurfacePoints(points, sums[:, 4:7] / weights, F.normalize(sums[:, 7:10], dim=-1), sure)

    def save(self, path: Path, now: bool = True) -> None:
        """Write everything to an ``.npz`` file; unless ``now``, only if that takes a small share of the time."""
        start = time.monotonic()
        if not now and start - self._written < RESTED * self._took:
            return
        with atomic_write(path) as temporary:
            frames = np.array(list(self.frames), dtype=np.str_)
            cubes, sums, origin = (each.numpy() for each in (self._cubes, self._sums, self.origin))
            np.savez(temporary, frames=frames, side=self.side, cubes=cubes, sums=sums, origin=origin)
        self._written = time.monotonic()
        self._took = self._written - start

    @classmethod
    def load(cls, path: Path) -> FusedCloud:
        """Read what ``save`` wrote."""
        keys = ("side", "frames", "cubes", "sums", "origin")
        arrays = read_npz(path, keys, MAX_STATE, "a fused cloud; delete it to fuse all frames again")
        try:
            fused = cls(float(arrays["side"]))
            fused.frames = dict.fromkeys(map(str, arrays["frames"].tolist()))
            fused._cubes, fused._sums, fused.origin = (torch.from_numpy(arrays[key]) for key in keys[2:])
            fits = fused._sums.shape == (len(fused._cubes), 12) and fused.origin.shape == (3,)
            if not fits or not fused.side > 0:
                raise ValueError(f"{tuple(fused._sums.shape)} sums of {len(fused._cubes)} cubes")
        except (ValueError, TypeError) as error:
            raise FileFormatError(
                f"{path}: no fused cloud ({error}); delete it to fuse all frames again"
            ) from error
        return fused

    def _positions(self) -> Tensor:
        """``(m, 3)`` metres from the origin, float64, of the means in all cubes."""
        rest = self._sums[:, 1:4] / self._sums[:, :1]
        return (_unpacked(self._cubes) + rest.double()) * self.side

    def _see_through(self, panorama: DepthImage, center: Tensor) -> None:
        rays = (self._positions() - center).float()
        distance = rays.norm(dim=-1)
        nearest = panorama.measured.cpu().nan_to_num(0.0)  # where nobody looks nobody sees through
        around = F.pad(F.pad(-nearest[None, None], (1, 1, 0, 0), "circular"), (0, 0, 1, 1), "replicate")
        nearest = -F.max_pool2d(around, 3, 1)[0]
        pixels = Equirectangular(*nearest.shape[-2:]).nearest(F.normalize(rays, dim=-1))
        past = nearest.flatten()[pixels]
        self._sums[:, THROUGH] += past > (1 + FARTHER) * distance + 2 * self.side

    def _coarsen(self) -> None:
        """Double the sides of the cubes; of eight that become one the most frequent says how many frames saw it."""
        cells = _unpacked(self._cubes)
        self._sums[:, 1:4] = (self._sums[:, 1:4] + self._sums[:, :1] * (cells & 1)) / 2
        coarse = _packed(cells >> 1)
        self._cubes, sums = _summed(coarse, self._sums)
        where = torch.searchsorted(self._cubes, coarse)[:, None].expand(-1, 2)
        counts = self._sums[:, CONFIRMED:]
        sums[:, CONFIRMED:] = torch.zeros(len(sums), 2).scatter_reduce_(0, where, counts, "amax")
        self._sums, self.side = sums, 2 * self.side


def _packed(cubes: Tensor) -> Tensor:
    """Places ``(n, 3)`` of cubes as a number each."""
    x, y, z = (cubes + 2 ** (BITS - 1)).unbind(-1)
    return (x << 2 * BITS) | (y << BITS) | z


def _unpacked(numbers: Tensor) -> Tensor:
    axes = (numbers >> 2 * BITS, numbers >> BITS, numbers)
    return (torch.stack(axes, -1) & (2**BITS - 1)) - 2 ** (BITS - 1)


def _summed(cubes: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Cubes in order, each once, and the sums of the rows of ``values`` that are of it."""
    unique, ids = cubes.unique(return_inverse=True)
    return unique, torch.zeros(len(unique), values.shape[1]).index_add_(0, ids, values)
