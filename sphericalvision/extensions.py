# SPDX-License-Identifier: Apache-2.0
"""Extensions by name: cameras, calibration formats, networks and the like, of this package and of installed ones."""

from __future__ import annotations

import os
import pkgutil
import sys
import warnings
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module, metadata
from importlib.metadata import EntryPoint, EntryPoints
from typing import Any, Generic, TypeVar

from sphericalvision.core import ArgumentError

Thing = TypeVar("Thing")


class Registry(Generic[Thing]):
    """All things of one kind by their names: this package's own, registered ones, and those of installed packages.

    None is imported before it is asked for. This package's own lie in one folder, and a module there adds what it has
    when it is imported: it is one file, with no list elsewhere that names it. Another package names its own as entry
    points, name -> thing.

    Args:
        argument: as errors call it.
        expected: what a thing is, in errors.
        fits: whether something is such a thing under this name.
        group: of the entry points.
        folder: the package that holds this package's own; a module that has the name of its thing is found at once.

    Examples:
        >>> sizes = Registry("size", "a number", lambda name, thing: isinstance(thing, int), "my_package.sizes")
        >>> sizes.add("large", 100)
        >>> sizes.find("large"), sizes.find("small"), sizes.names()
        (100, None, ('large',))
    """

    def __init__(
        self,
        argument: str,
        expected: str,
        fits: Callable[[str, Any], bool],
        group: str,
        folder: str | None = None,
    ) -> None:
        self.argument, self.expected, self.fits = argument, expected, fits
        self.group, self.folder = group, folder
        self.things: dict[str, Thing] = {}
        """Those that were imported so far."""
        self._complete = False
        self._broken: set[str] = set()

    def add(self, name: str, thing: Thing) -> None:
        """Make a thing known by its name.

        Raises:
            ArgumentError: it does not fit, or the name is another one's.
        """
        if not self.fits(name, thing):
            raise ArgumentError(
                f"{self.argument}: expected {self.expected} for the name {name!r}, got {thing!r}"
            )
        self._import_own(name)  # whose name nobody else may take
        existing = self.things.get(name, thing)
        if _identity(existing) != _identity(thing):
            raise ArgumentError(
                f"{self.argument}: {name!r} is {_identity(existing)} already; choose another name for "
                f"{_identity(thing)}"
            )
        self.things[name] = thing  # also where it was defined anew, as when a notebook's cell runs again

    def find(self, name: str) -> Thing | None:
        """The thing of a name, or None.

        Raises:
            ArgumentError: an installed package offers it, but cannot be imported, or offers something else.
        """
        if name not in self.things:
            self._import_own(name)
        if name not in self.things:
            self._import_own()
        if name not in self.things:
            for point in entry_points(group=self.group).select(name=name):
                self._follow(point)
        return self.things.get(name)

    def names(self) -> tuple[str, ...]:
        """The names of all, in alphabetical order; those of other packages without importing them."""
        self._import_own()
        return tuple(sorted({*self.things, *entry_points(group=self.group).names}))

    def all(self) -> list[Thing]:
        """All things in the order of their names; a warning, once, names those of packages that are broken."""
        things = []
        for name in self.names():
            try:
                things.append(self.find(name))
            except ArgumentError as error:
                if name not in self._broken:
                    self._broken.add(name)
                    warnings.warn(f"{error}; all else goes on without it", stacklevel=2)
        return [thing for thing in things if thing is not None]

    def name_of(self, thing: Thing) -> str | None:
        """The name of a class, or None; an installed package that offers it need not have been asked before."""
        for name, other in self.things.items():
            if other is thing:
                return name
        for point in entry_points(group=self.group):
            # The package of a class has been imported, so only its own entry points are worth following.
            same_package = point.module.partition(".")[0] == thing.__module__.partition(".")[0]
            if same_package and self._follow(point) is thing:
                return point.name
        return None

    def _import_own(self, name: str | None = None) -> None:
        """Import the module of a name, if there is one, or all of them."""
        if self.folder is None or self._complete:
            return
        for module in pkgutil.iter_modules(import_module(self.folder).__path__):
            if not module.ispkg and name in (None, module.name):
                import_module(f"{self.folder}.{module.name}")
        self._complete = name is None

    def _follow(self, point: EntryPoint) -> Thing:
        try:
            thing: Thing = point.load()
        except Exception as error:  # whatever a module of somebody else does when it is imported
            package = point.dist.name if point.dist else point.module
            raise ArgumentError(
                f"{self.argument}: {point.name!r} is {point.value} of the package {package}, which cannot be "
                f"imported: {type(error).__name__}: {error}; repair or uninstall it"
            ) from error
        try:
            self.add(point.name, thing)
        except ArgumentError as error:
            raise ArgumentError(f"{error} (the entry point {point.value} of {self.group})") from None
        return thing


def entry_points(group: str) -> EntryPoints:
    """Entry points of a group, of all installed packages; an installation since the last call is noticed."""
    return _entry_points(group, tuple(map(_last_change, sys.path)))


@lru_cache(maxsize=32)
def _entry_points(group: str, changes: tuple[tuple[str, int], ...]) -> EntryPoints:
    # Kept, because files of all installed packages are read for it: 20 ms with 180 packages, twice a calibration file.
    return metadata.entry_points(group=group)


def _last_change(folder: str) -> tuple[str, int]:
    """A folder of ``sys.path``, and when a package was last added to or removed from it."""
    try:
        return folder, os.stat(folder or ".").st_mtime_ns
    except OSError:  # folders that do not exist are allowed there
        return folder, 0


def _identity(thing: Any) -> Any:
    """What tells two things apart: a class or function by where it is defined, anything else by itself."""
    return f"{thing.__module__}.{thing.__qualname__}" if hasattr(thing, "__qualname__") else thing
