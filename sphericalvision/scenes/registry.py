# SPDX-License-Identifier: Apache-2.0
"""Kinds of scenes by name: those of the folder ``kinds``, registered ones, and those of installed packages."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from sphericalvision.core import check_choice
from sphericalvision.extensions import Registry
from sphericalvision.scenes.rendering.scene import Scene

ENTRY_POINTS = "sphericalvision.scenes"
"""Group of entry points, name -> recipe of a scene, in which other packages offer theirs."""

Recipe = Callable[[torch.Generator, float], Scene]
"""From ``generator``, the source of every random choice, and ``clear_radius``, metres around the rig in which nothing
stands, to a scene: the rig at its origin, y down, not yet exposed."""

TURNS = ("room", "floating", "hall", "corridor", "bare", "polished", "outdoors")
"""Kinds that take turns from frame to frame of the benchmark, whose frames stay the same when a kind is added."""

KINDS: Registry[Recipe] = Registry(
    "kind",
    "a function that makes a scene",
    lambda name, make: bool(name) and callable(make),
    ENTRY_POINTS,
    folder="sphericalvision.scenes.kinds",
)

_UNDER_OTHER_SKIES: set[str] = set()


def register_scene(name: str, *, other_sky: bool = False) -> Callable[[Recipe], Recipe]:
    """Make a recipe known as a kind of scene, for ``make_scene``, data sets, commands and the benchmark.

    A module of the folder ``sphericalvision/scenes/kinds`` is found there. A package that others install names its
    recipes as entry points of the group ``sphericalvision.scenes``, and they are found without being imported.

    Args:
        name: of the kind; recipes may have several.
        other_sky: whether the scenes come under a sky of any colour, or a cloudy one, in place of their own.

    Raises:
        ArgumentError: another recipe has the name already.

    Examples:
        >>> from sphericalvision.scenes import make_scene
        >>> from sphericalvision.scenes.kinds.floating import random_floating_objects
        >>> @register_scene("few")
        ... def few_things(generator, clear_radius=0.6):
        ...     return random_floating_objects(generator, 2 * clear_radius)
        >>> len(make_scene("few", seed=1).lamps.position)
        2
    """

    def register(make: Recipe) -> Recipe:
        KINDS.add(name, make)
        if other_sky:
            _UNDER_OTHER_SKIES.add(name)
        return make

    return register


def scene_kinds() -> tuple[str, ...]:
    """Names of all kinds: ``TURNS``, then the others by name.

    Examples:
        >>> scene_kinds()[:3]
        ('room', 'floating', 'hall')
    """
    return (*TURNS, *(name for name in KINDS.names() if name not in TURNS))


def scene_recipe(name: str) -> Recipe:
    """What makes the scenes of a kind."""
    make = KINDS.find(name)
    if make is None:
        check_choice("kind", name, scene_kinds())
    assert make is not None
    return make


def under_other_skies(name: str) -> bool:
    """Whether scenes of a kind come under a sky of any colour, or a cloudy one, in place of their own."""
    return name in _UNDER_OTHER_SKIES


def kind_of(kind: str | Sequence[str], seed: int) -> str:
    """Tell the kind of scene of a seed: of several they take turns.

    Args:
        kind: of ``scene_kinds``, or several.
        seed: of the scene.

    Examples:
        >>> kind_of("room", 5), kind_of(("room", "floating"), 4), kind_of(("room", "floating"), 5)
        ('room', 'room', 'floating')
    """
    turns, kinds = (kind,) if isinstance(kind, str) else tuple(kind), scene_kinds()
    for name in turns or ("",):
        check_choice("kind", name, kinds)
    return turns[seed % len(turns)]
