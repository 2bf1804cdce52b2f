# SPDX-License-Identifier: Apache-2.0
"""Depth on the icosphere, and values on the sphere itself, as triangle meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from sphericalvision.icosphere import Icosphere, level_from_num_vertices
from sphericalvision.shapes import check_shapes
from sphericalvision.viz.color import colorize

if TYPE_CHECKING:
    import trimesh


@check_shapes
def icosphere_mesh(depth: Float[Tensor, " V"], colors: Float[Tensor, "3 V"] | None = None) -> trimesh.Trimesh:
    """Surface through depth on the vertices of an icosphere, torn open where depth jumps by a fifth.

    Args:
        depth: ``(V,)`` metres; triangles with a corner that is infinite, NaN or not positive are left out.
        colors: ``(3, V)`` in [0, 1] at the vertices; grey when not given.

    Returns:
        A mesh in the rig's frame, facing the rig's centre; ``.export("room.ply")`` writes it.

    Raises:
        ShapeError: no icosphere has V vertices.

    Examples:
        >>> mesh = icosphere_mesh(torch.full((42,), 2.0))
        >>> len(mesh.faces), mesh.is_watertight
        (80, True)
    """
    grid = Icosphere(level_from_num_vertices(len(depth)), device=depth.device)
    if colors is None:
        colors = depth.new_full((3, len(depth)), 0.7)
    return surface_mesh(grid.vertices, grid.faces, depth, colors, 1.2)


def surface_mesh(
    directions: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    depth: Float[Tensor, " V"],
    colors: Float[Tensor, "3 V"],
    max_jump: float,
) -> trimesh.Trimesh:
    """As ``icosphere_mesh``, on any grid of unit directions, whose triangles turn outwards.

    Examples:
        >>> grid, ones = Icosphere(1), torch.ones(42)
        >>> len(surface_mesh(grid.vertices, grid.faces, ones, torch.ones(3, 42), 1.2).faces)
        80
    """
    valid = depth.isfinite() & (depth > 0)
    safe = torch.where(valid, depth, 1.0)
    corners = safe[faces]
    valid_faces = valid[faces].all(-1) & (corners.amax(-1) <= max_jump * corners.amin(-1))
    levels = (colors.clamp(0, 1) * 255).round().to(torch.uint8)
    import trimesh  # a second to import

    mesh = trimesh.Trimesh(
        vertices=(directions * safe[:, None]).detach().cpu().numpy(),
        faces=faces[valid_faces].flip(-1).cpu().numpy(),  # seen from inside
        vertex_colors=levels.T.detach().cpu().numpy(),
        process=False,
    )
    mesh.remove_unreferenced_vertices()
    return mesh


@check_shapes
def sphere_mesh(values: Shaped[Tensor, " V"] | Float[Tensor, "3 V"], radius: float = 1.0) -> trimesh.Trimesh:
    """The icosphere itself, coloured by values, as a mesh seen from outside.

    Args:
        values: ``(V,)``, coloured by a map from the smallest to the largest finite one, or colours ``(3, V)`` in
            [0, 1].
        radius: of the sphere.

    Returns:
        A mesh whose vertices are in the order of the icosphere; ``.export("sphere.ply")`` writes it.

    Raises:
        ShapeError: no icosphere has V vertices.

    Examples:
        >>> mesh = sphere_mesh(torch.arange(162.0))
        >>> len(mesh.faces), mesh.is_watertight
        (320, True)
    """
    grid = Icosphere(level_from_num_vertices(values.shape[-1]))
    values = values.detach().cpu().double()
    if values.ndim == 2:
        colors = (values.T.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    else:
        finite = values[values.isfinite()]
        low, high = (finite.min(), finite.max()) if len(finite) else (values.new_zeros(()),) * 2
        scaled = (values - low) / (high - low).clamp(min=torch.finfo(values.dtype).tiny)
        colors = colorize(scaled.numpy(), "viridis")
    import trimesh

    return trimesh.Trimesh(
        vertices=(radius * grid.vertices).numpy(),
        faces=grid.faces.numpy(),
        vertex_colors=colors,
        process=False,
    )
