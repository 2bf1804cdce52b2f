# SPDX-License-Identifier: Apache-2.0
"""What surfaces of generated scenes are, for semantic segmentation."""

from __future__ import annotations

from dataclasses import replace

from sphericalvision.scenes.rendering.primitives import Part

SURFACE_LABELS = (
    "other", "floor", "ceiling", "wall", "door", "window", "picture",
    "lamp", "table", "seat", "storage", "bed", "plant",
)  # fmt: skip
"""What label 0, 1, 2, ... of ``ray_labels`` means. "other" is small things, and in other kinds of scenes than rooms
whatever nobody has named."""


def labelled(parts: list[Part], name: str) -> list[Part]:
    """The parts as surfaces of one name among ``SURFACE_LABELS``.

    Examples:
        >>> labelled([Part("box", (0.0, 0.0, 2.0), (0.5, 0.5, 0.5))], "table")[0].label
        8
    """
    label = SURFACE_LABELS.index(name)
    return [replace(part, label=label) for part in parts]
