# SPDX-License-Identifier: Apache-2.0
"""Kinds of scenes by name: those of the folder ``kinds``, registered ones, and those of installed packages."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from functools import cache
from importlib import import_module, metadata
from typing import NamedTuple

import torch

from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.scenes.rendering.scene import Scene

__all__ = ["ENTRY_POINTS", "MIXTURES", "SceneKind", "kind_of", "register_scene", "scene_kind", "scene_kinds"]

ENTRY_POINTS = "sphericalvision.scenes"
"""Group of entry points, name -> recipe of a scene, in which other packages offer theirs."""

Recipe = Callable[[torch.Generator, float], Scene]

#: Kinds that take turns from seed to seed, by the name of the mixture. Lists that stay as they are, whatever kinds are
#: added: so a seed of a mixture means the same scene for ever.
MIXTURES = {
    "mixed": ("room", "floating"),
    "all": ("room", "floating", "hall", "corridor", "bare", "polished", "outdoors"),
}


class SceneKind(NamedTuple):
    """A kind of scene.

    Attributes:
        make: from a generator of randomness and the free space around the rig in metres to a scene, the rig at its
            origin, y down, not yet exposed.
        other_sky: whether it comes under a sky of any colour, or a cloudy one, in place of its own.
    """

    make: Recipe
    other_sky: bool = False


_KINDS: dict[str, SceneKind] = {}


def register_scene(name: str, *, other_sky: bool = False) -> Callable[[Recipe], Recipe]:
    """Make a recipe known as a kind of scene, for ``make_scene``, data sets, commands and the benchmark.

    A module of the folder ``sphericalvision/scenes/kinds`` is found there. A package that others install names its
    recipes as entry points of the group ``sphericalvision.scenes``, and they are found without being imported.

    Args:
        name: of the kind; recipes may have several.
        other_sky: whether the scenes come under a sky of any colour, or a cloudy one, in place of their own.

    Raises:
        ArgumentError: another recipe or a mixture has the name already.

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
        known = _KINDS.get(name, SceneKind(make)).make
        mine = (make.__module__, make.__qualname__)
        if name in MIXTURES or (known.__module__, known.__qualname__) != mine:
            raise ArgumentError(f"name: {name!r} is a kind or mixture of scenes already; choose another name")
        _KINDS[name] = SceneKind(make, other_sky)
        return make

    return register


@cache
def _read_folder() -> None:
    """Import every module of the folder of kinds, which register themselves."""
    folder = import_module("sphericalvision.scenes.kinds")
    for module in pkgutil.iter_modules(folder.__path__, f"{folder.__name__}."):
        import_module(module.name)


def scene_kinds() -> tuple[str, ...]:
    """Names of all kinds: those of the mixture "all" in its order, then the others by name.

    Examples:
        >>> scene_kinds()[:3]
        ('room', 'floating', 'hall')
    """
    _read_folder()
    others = {*_KINDS, *metadata.entry_points(group=ENTRY_POINTS).names} - set(MIXTURES["all"])
    return (*MIXTURES["all"], *sorted(others))


def scene_kind(name: str) -> SceneKind:
    """The kind of a name.

    Raises:
        ArgumentError: there is none.
    """
    _read_folder()
    if name not in _KINDS:
        for entry in metadata.entry_points(group=ENTRY_POINTS, name=name):
            make = entry.load()  # which may register itself, to say more than the name
            if name not in _KINDS:
                register_scene(name)(make)
    if name not in _KINDS:
        check_choice("kind", name, scene_kinds())
    return _KINDS[name]


def kind_of(kind: str, seed: int) -> str:
    """Tell the kind of scene of a seed: mixtures take turns, any other kind is itself.

    Args:
        kind: of ``scene_kinds``, or a mixture of ``MIXTURES``: ``"mixed"``, rooms for even seeds and floating objects
            for odd ones, or ``"all"``.
        seed: of the scene.

    Raises:
        ArgumentError: an unknown kind.

    Examples:
        >>> kind_of("mixed", 4), kind_of("mixed", 5), kind_of("room", 5)
        ('room', 'floating', 'room')
    """
    if kind not in MIXTURES and kind not in scene_kinds():
        check_choice("kind", kind, (*scene_kinds(), *MIXTURES))
    turns = MIXTURES.get(kind, (kind,))
    return turns[seed % len(turns)]
