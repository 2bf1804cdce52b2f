# SPDX-License-Identifier: Apache-2.0
"""Point location on one icosphere for whoever fills large tables in parts: ``TriangleLocator``.

The one door to the fast wing of this package, which finds a triangle by a table of cells and a few steps across
edges where the reference descends level by level. Both give the same triangles and weights but for rounding.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from sphericalvision.core import is_recording, uses_reference_kernels
from sphericalvision.icosphere.descent import barycentric_weights, convex, descend
from sphericalvision.icosphere.fast.triangle_table import (
    coefficients,
    find_in_few_steps,
    find_triangles,
    triangle_table,
)
from sphericalvision.icosphere.mesh import icosphere_vertices
from sphericalvision.icosphere.topology import check_level, icosphere_faces

__all__ = ["TriangleLocator", "chunk_size", "fast_wing_open"]

#: Rays at once, which bounds the memory in use.
CHUNK, CHUNK_ON_DEVICE = 1 << 17, 1 << 22


def chunk_size(device: torch.device) -> int:
    """Return how many rays to locate at once: on a CPU so few that they stay in the cache.

    Examples:
        >>> chunk_size(torch.device("cpu")) >= 1 << 17
        True
    """
    # torch gives a thread at least 32768 numbers.
    return max(CHUNK, torch.get_num_threads() << 15) if device.type == "cpu" else CHUNK_ON_DEVICE


def fast_wing_open() -> bool:
    """Whether triangles may be found by tables here and now.

    Tables are kept between calls, which an exported program cannot do, and how many steps rays take depends on the
    rays, whose values it does not know.

    Examples:
        >>> from sphericalvision.core import reference_kernels
        >>> with reference_kernels():
        ...     fast_wing_open()
        False
    """
    return is_recording() or not (uses_reference_kernels() or torch.compiler.is_exporting())


class TriangleLocator:
    """Finds the triangles that rays pierce, with tables of one icosphere made once.

    Rays are columns ``(3, m)``, so that every operation runs over contiguous memory; they may be of any length but
    zero. ``locate`` is the same for directions ``(*, 3)`` of unit length or not.

    Args:
        level: subdivision level of the icosphere.
        dtype: of the rays, float32 or float64.
        device: of the rays.

    Attributes:
        faces: ``(F, 3)`` vertex ids of the triangles, those of ``icosphere_faces``.
        chunk_size: how many rays to locate at once, so few that they stay in the cache.

    Raises:
        ArgumentError: if no icosphere has this level.

    Examples:
        >>> locator = TriangleLocator(level=1)
        >>> triangles, weights = locator.find(torch.tensor([[0.0], [-2.0], [0.0]]))
        >>> locator.faces[triangles[0], weights[:, 0].argmax()]  # straight up is the north pole
        tensor(0)
    """

    def __init__(
        self, level: int, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> None:
        self.level = check_level(level)
        device = torch.device(device)
        self.chunk_size = chunk_size(device)
        self._table = triangle_table(level, dtype, device) if fast_wing_open() else None
        self.faces = icosphere_faces(level, device) if self._table is None else self._table.ids

    @torch.no_grad()
    def find(self, rays: Float[Tensor, "3 m"]) -> tuple[Int[Tensor, " m"], Float[Tensor, "3 m"]]:
        """Return the numbers ``(m,)`` of the triangles that rays ``(3, m)`` pierce, and the weights ``(3, m)`` there.

        A ray of zero length or with a NaN gets some triangle and NaN weights. Weights have no gradients; those of
        ``weights`` have.
        """
        if self._table is None:
            unit = F.normalize(rays.T, dim=-1)
            found = descend(unit, self.level)
            return found.numbers(self.level), barycentric_weights(unit, found.corners).T
        if is_recording():
            return find_in_few_steps(rays, self._table)
        triangles, shares = find_triangles(rays, self._table)
        shares = shares.clamp_(min=0)
        return triangles, shares.div_(shares.sum(0))

    def weights(self, rays: Float[Tensor, "3 m"], triangles: Int[Tensor, " m"]) -> Float[Tensor, "3 m"]:
        """Return the weights ``(3, m)`` of the corners of triangles ``(m,)``, differentiable in the rays ``(3, m)``."""
        if self._table is None:
            vertices = icosphere_vertices(self.level, torch.float64, rays.device).to(rays.dtype)
            a, b, c = vertices[self.faces[triangles]].unbind(1)
            return barycentric_weights(F.normalize(rays.T, dim=-1), (a, b, c)).T
        return convex(coefficients(rays, triangles, self._table), 0)
