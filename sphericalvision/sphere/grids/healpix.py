# SPDX-License-Identifier: Apache-2.0
"""The HEALPix grid: pixels of equal area on rings of equal latitude."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.core import check_choice, check_counts, check_last_dim
from sphericalvision.geometry import longitude_latitude_from_directions, normalize
from sphericalvision.geometry.directions import (
    check_directions,
    components,
    from_components,
    moderate_lengths,
    safe_hypot,
)
from sphericalvision.geometry.lookup import weighted_sums
from sphericalvision.sphere.grids.healpix_pixels import (
    direction_of_place,
    neighbor_places,
    nested_from_place,
    nested_from_ring,
    place_from_nested,
    place_from_ring,
    place_of_direction,
    ring_from_place,
    ring_start_count_shift,
    ring_theta,
)
from sphericalvision.sphere.grids.sphere_grid import GridModule, check_cells


class Healpix(GridModule):
    """``12 * nside**2`` pixels of one area, numbered ring by ring or nested.

    Convention:
        The numbers are healpy's, with its angle θ measured from up (-y) and its longitude φ equal to ours: zero
        forward (+z), growing to the right (+x). Seen from outside, as astronomers draw maps of the sky from inside,
        east is where they expect it. In the nested order pixel p of ``nside`` contains the pixels 4p to 4p + 3 of
        ``2 * nside``.

    Args:
        nside: pixels along the edge of each of the twelve base faces; a power of two for the nested order.
        nested: whether pixels are numbered nested; ring by ring, north first, otherwise.
        dtype: of the directions; the default dtype of torch when not given.
        device: of all tables.

    Raises:
        ArgumentError: if nside is not a positive integer or too large, or for the nested order no power of two.

    References:
        K. M. Górski et al. (2005), "HEALPix: a framework for high-resolution discretization and fast analysis of
        data distributed on the sphere".

    Examples:
        >>> grid = Healpix(2)
        >>> grid
        Healpix(nside=2, nested=False, pixels=48)
        >>> grid.nearest(torch.tensor([[0.1, -1.0, 0.1], [0.1, 1.0, 0.1]])).tolist()  # up and down
        [0, 44]
    """

    def __init__(
        self,
        nside: int,
        nested: bool = False,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        check_counts(nside=nside)
        check_cells(12 * nside**2, nside=nside)
        self.nside = nside
        self.nested = bool(nested)
        self.num_pixels = 12 * nside**2
        self._make_directions(dtype, device)

    @property
    def shape(self) -> tuple[int]:
        """Shape of values on this grid, ``(12 * nside**2,)``."""
        return (self.num_pixels,)

    @property
    def solid_angles(self) -> Float[Tensor, " pixels"]:
        """Solid angle of each pixel ``(12 * nside**2,)`` in steradians, all the same."""
        return self.directions.new_full(self.shape, 4 * math.pi / self.num_pixels)

    def cell_samples(
        self, samples: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> tuple[Float[Tensor, "P k 3"], Float[Tensor, "#P k"]]:
        """Directions ``(n, samples**2, 3)`` spread over each pixel, and their equal shares of its solid angle."""
        ids = torch.arange(self.num_pixels, device=device)
        of = place_from_nested if self.nested else place_from_ring
        face, column, row = (part[:, None] for part in of(ids, self.nside))
        inside = (torch.arange(samples, dtype=torch.float64, device=device) + 0.5) / samples
        x = (column + inside.repeat(samples)) / self.nside
        y = (row + inside.repeat_interleave(samples)) / self.nside
        directions = direction_of_place(face.expand_as(x), x, y).to(dtype or self.directions.dtype)
        return directions, torch.full_like(directions[..., 0], 1 / samples**2)

    def nearest(self, directions: Float[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """Return the number ``(*)`` of the pixel that contains each direction ``(*, 3)``.

        Examples:
            >>> Healpix(1).nearest(torch.tensor([0.0, 0.0, 1.0])).item()
            4
        """
        check_directions(directions)
        face, x, y = place_of_direction(normalize(directions.detach()))
        column, row = ((side * self.nside).floor().long().clamp(0, self.nside - 1) for side in (x, y))
        number = nested_from_place if self.nested else ring_from_place
        return number(face, column, row, self.nside)

    @property
    def neighbors(self) -> Int[Tensor, "pixels 8"]:
        """Numbers ``(12 * nside**2, 8)`` of the pixels around each: south-west, west, north-west, ..., south.

        -1 where there is none: 24 pixels (all twelve, twice, for ``nside`` 1) have seven neighbours.

        Examples:
            >>> Healpix(4).neighbors[0].tolist()  # one of the four around the north pole
            [4, 11, 3, 2, 1, 6, 5, 13]
        """
        ids = torch.arange(self.num_pixels, device=self.directions.device)
        of = place_from_nested if self.nested else place_from_ring
        face, column, row, exists = neighbor_places(*of(ids, self.nside), self.nside)
        number = nested_from_place if self.nested else ring_from_place
        return torch.where(exists, number(face, column, row, self.nside), -1)

    def locate(
        self, directions: Float[Tensor, "*batch 3"], interpolation: str = "healpy"
    ) -> tuple[Int[Tensor, "*batch 4"], Float[Tensor, "*batch 4"]]:
        """Return four pixels ``(*, 4)`` around each direction and their weights ``(*, 4)``, which sum to one.

        Two neighbours on the ring above and two on the ring below. Beyond the first and the last ring the pole has the
        mean of the ring's four pixels. Weights are differentiable in the directions.

        Args:
            directions: ``(*, 3)`` of any length but zero.
            interpolation: ``"healpy"``, linear in longitude on each ring and in latitude between them, the numbers of
                ``healpy.get_interp_weights``. Close to the poles that takes values on the chord between two pixels
                for values on the circle, an error of first order. ``"chords"`` is linear between the points of both
                chords at the direction's longitude, and of second order everywhere; ``resample`` uses it.

        Examples:
            >>> ids, weights = Healpix(1).locate(torch.tensor([0.0, -1.0, 0.0]))  # straight up
            >>> weights
            tensor([0.2500, 0.2500, 0.2500, 0.2500])
        """
        check_last_dim("directions", directions, 3)
        check_choice("interpolation", interpolation, ("healpy", "chords"))
        flat = directions.reshape(-1, 3)
        longitude, _ = longitude_latitude_from_directions(flat)
        x, y, z = components(moderate_lengths(flat))
        theta = torch.atan2(safe_hypot(x, z), -y)
        chords = interpolation == "chords"
        last = 4 * self.nside - 1
        above = self._ring_above(theta.detach())
        if chords:  # a ring's polygon lies on the pole's side of its circle
            with torch.no_grad():
                into_next = theta >= self._on_ring(above + 1, longitude, chords)[2]
                into_previous = theta < self._on_ring(above, longitude, chords)[2]
            above = (above + into_next.long() - into_previous.long()).clamp(0, last)
        ids_above, share_above, theta_above = self._on_ring(above, longitude, chords)
        ids_below, share_below, theta_below = self._on_ring(above + 1, longitude, chords)
        below = (theta - theta_above) / (theta_below - theta_above)
        north, south = ((above == end).to(theta.dtype) for end in (0, last))
        pole = (north * (1 - below) + south * below) / 4  # its share goes to all four pixels of its ring
        weight_above, weight_below = (1 - below) * (1 - north), below * (1 - south)
        pairs = ((weight_above, share_above), (weight_below, share_below))
        weights = from_components(*(w * part + pole for w, share in pairs for part in (1 - share, share)))
        ids = torch.stack((*ids_above, *ids_below), -1)
        ids = nested_from_ring(ids, self.nside) if self.nested else ids
        return ids.view(*directions.shape[:-1], 4), weights.view(*directions.shape[:-1], 4)

    def taps(
        self, directions: Float[Tensor, "*batch 3"]
    ) -> tuple[Int[Tensor, "*batch 4"], Float[Tensor, "*batch 4"]]:
        """Pixels and weights that ``resample`` uses: ``locate`` between chords."""
        return self.locate(directions, "chords")

    def _ring_above(self, theta: Tensor) -> Tensor:
        """The last ring, 0 (the pole) to ``4 * nside - 1``, whose angle is not more than theta."""
        thetas, last = self._rings(theta)[-1], 4 * self.nside - 1
        # Looked up by parts of the angle narrower than rings are apart, so that it is this one or the next.
        steps = 6 * self.nside
        starts = torch.arange(steps + 1, device=theta.device).to(theta.dtype) * (math.pi / steps)
        first = torch.searchsorted(thetas[1:-1].contiguous(), starts - 0.01 / steps, right=True)
        ring = first.index_select(0, (theta * (steps / math.pi)).long().clamp(0, steps))
        return (ring + (theta >= thetas.index_select(0, ring + 1)).long()).clamp(max=last)

    def _rings(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Of each ring from pole to pole: first pixel, number of pixels, shift, pixels to skip, angle from the north.

        Many directions share few rings: looked up, these cost a fraction of what they do computed for each. A pole has
        the pixels of the ring around it, seen from behind.
        """
        ring = torch.arange(4 * self.nside + 1, device=like.device)
        start, count, shift = ring_start_count_shift(ring.clamp(1, 4 * self.nside - 1), self.nside)
        behind = 2 * (ring % (4 * self.nside) == 0)
        return start, count, shift, behind, ring_theta(ring, self.nside, like.dtype)

    def _on_ring(
        self, ring: Tensor, longitude: Tensor, chords: bool
    ) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
        """Two pixels of rings ``(n,)`` on either side of longitudes, the second's share, and the ring's polar angle.

        A ring's angle differs from one longitude to the next where it is a polygon of chords.
        """
        start, count, shift, behind, theta = (part.index_select(0, ring) for part in self._rings(longitude))
        step = (2 * math.pi) / count.to(longitude.dtype)
        position = longitude / step - 0.5 * shift
        first = position.detach().floor()
        fraction = position - first
        if chords:
            before, after = (fraction * step).sin(), ((1 - fraction) * step).sin()
            radius = theta.sin() * (step / 2).cos() / ((fraction - 0.5) * step).cos()
            theta = torch.where(behind == 0, torch.atan2(radius, theta.cos()), theta)  # a pole is a point
            fraction = before / (before + after)
        number = first.nan_to_num().long() + behind  # a number of the ring, whatever the direction
        number = number + count * (number < 0)
        return (start + number, start + (number + 1) * (number + 1 != count)), fraction, theta

    def _interpolated(self, values: Tensor, directions: Tensor) -> Tensor:
        return weighted_sums(values, *self.locate(directions))

    def extra_repr(self) -> str:
        return f"nside={self.nside}, nested={self.nested}, pixels={self.num_pixels}"
