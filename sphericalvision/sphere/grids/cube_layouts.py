# SPDX-License-Identifier: Apache-2.0
"""Faces of cube maps: their names and axes; as one picture, a list or a dictionary, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Shaped
from torch import Tensor

from sphericalvision.core import ArgumentError, ShapeError, check_choice
from sphericalvision.shapes import check_shapes

CUBE_FACES = ("front", "right", "back", "left", "up", "down")
"""Names of the faces of a cube map in their order."""

CUBE_LAYOUTS = ("dice", "strip", "list", "dict")
"""What ``cube_to_layout`` and ``cube_from_layout`` know."""

_DICE = {"left": (1, 0), "front": (1, 1), "right": (1, 2), "back": (1, 3), "up": (0, 1), "down": (2, 1)}

_RIGHT_DOWN_FORWARD = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),  # front
    ((0, 0, -1), (0, 1, 0), (1, 0, 0)),  # right
    ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),  # back
    ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),  # left
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),  # up: its lower edge meets the front face
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),  # down: its upper edge meets the front face
)


def world_from_cube_face(
    dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Shaped[Tensor, "6 3 3"]:
    """Rotations ``(6, 3, 3)`` whose columns are the right, down and forward axes of each face.

    Examples:
        >>> world_from_cube_face()[1] @ torch.tensor([0.0, 0.0, 1.0])  # the right face looks along +x
        tensor([1., 0., 0.])
    """
    axes = torch.tensor(_RIGHT_DOWN_FORWARD, dtype=dtype or torch.get_default_dtype(), device=device)
    return axes.transpose(1, 2)


@check_shapes
def cube_to_layout(
    values: Shaped[Tensor, "*batch 6 s s"], layout: str = "dice", fill: float = 0.0
) -> (
    Shaped[Tensor, "*batch _ _"]
    | list[Shaped[Tensor, "*batch s s"]]
    | dict[str, Shaped[Tensor, "*batch s s"]]
):
    """Arrange the faces of a cube map.

    Args:
        values: ``(*, 6, s, s)``, front, right, back, left, up, down.
        layout: ``"dice"``, the unfolded cube ``(*, 3 s, 4 s)``: left, front, right and back in a row, up above and down
            below the front, with no face turned; ``"strip"``, the faces side by side ``(*, s, 6 s)``; ``"list"`` and
            ``"dict"`` (by name) of faces ``(*, s, s)``.
        fill: what stands in the empty places of the dice.

    Examples:
        >>> cube_to_layout(torch.arange(6).view(6, 1, 1), "dice", fill=-1)
        tensor([[-1,  4, -1, -1],
                [ 3,  0,  1,  2],
                [-1,  5, -1, -1]])
        >>> list(cube_to_layout(torch.zeros(6, 2, 2), "dict"))
        ['front', 'right', 'back', 'left', 'up', 'down']
    """
    check_choice("layout", layout, CUBE_LAYOUTS)
    faces = list(values.unbind(-3))
    if layout == "list":
        return faces
    if layout == "dict":
        return dict(zip(CUBE_FACES, faces, strict=True))
    if layout == "strip":
        return torch.cat(faces, -1)
    empty = torch.full_like(faces[0], fill)
    rows = [[empty] * 4 for _ in range(3)]
    for name, face in zip(CUBE_FACES, faces, strict=True):
        row, column = _DICE[name]
        rows[row][column] = face
    return torch.cat([torch.cat(row, -1) for row in rows], -2)


def cube_from_layout(
    faces: Shaped[Tensor, " ..."]
    | Sequence[Shaped[Tensor, "*batch s s"]]
    | Mapping[str, Shaped[Tensor, "*batch s s"]],
    layout: str = "dice",
) -> Shaped[Tensor, "*batch_out 6 s s"]:
    """Return the cube map ``(*, 6, s, s)`` that ``cube_to_layout`` arranged.

    Examples:
        >>> cube = torch.rand(3, 6, 4, 4)
        >>> all(torch.equal(cube_from_layout(cube_to_layout(cube, name), name), cube) for name in CUBE_LAYOUTS)
        True
    """
    check_choice("layout", layout, CUBE_LAYOUTS)
    if isinstance(faces, Mapping):
        if layout != "dict" or set(faces) != set(CUBE_FACES):
            raise ArgumentError(
                f"faces: expected layout 'dict' with the keys {', '.join(CUBE_FACES)}, got layout {layout!r} with "
                f"{', '.join(map(str, faces))}"
            )
        return torch.stack([faces[name] for name in CUBE_FACES], -3)
    if not isinstance(faces, Tensor):
        if layout != "list" or len(faces) != 6:
            raise ArgumentError(
                f"faces: expected layout 'list' with 6 faces, got {layout!r} with {len(faces)}"
            )
        return torch.stack(list(faces), -3)
    down, across = {"dice": (3, 4), "strip": (1, 6)}.get(layout, (0, 0))
    side = faces.shape[-1] // max(across, 1)
    if not across or faces.ndim < 2 or tuple(faces.shape[-2:]) != (down * side, across * side):
        raise ShapeError(
            f"faces: expected one picture (*, 3 s, 4 s) for 'dice' or (*, s, 6 s) for 'strip', got "
            f"{tuple(faces.shape)} for {layout!r}"
        )
    cells = faces.unflatten(-1, (across, side)).unflatten(-3, (down, side)).movedim(-2, -3)
    if layout == "strip":
        return cells[..., 0, :, :, :]
    return torch.stack([cells[..., _DICE[name][0], _DICE[name][1], :, :] for name in CUBE_FACES], -3)
