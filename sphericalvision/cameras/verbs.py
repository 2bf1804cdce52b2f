# SPDX-License-Identifier: Apache-2.0
"""Methods of ``Camera`` and ``CameraRig`` that are written in modules above them, which import both.

Such a module registers its function here under the method's name; the method looks it up when it is called.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

__all__ = ["implements", "verb"]

AnyFunction = TypeVar("AnyFunction", bound=Callable[..., Any])

_VERBS: dict[str, Callable[..., Any]] = {}


def implements(name: str) -> Callable[[AnyFunction], AnyFunction]:
    """Decorate the function behind the method ``name``, such as ``"Camera.convert"``."""

    def register(function: AnyFunction) -> AnyFunction:
        _VERBS[name] = function
        return function

    return register


def verb(name: str) -> Callable[..., Any]:
    """The function behind the method ``name``; importing ``sphericalvision.cameras`` registers all of them."""
    return _VERBS[name]
