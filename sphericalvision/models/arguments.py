# SPDX-License-Identifier: Apache-2.0
"""Networks that know how they were constructed, which is what a file of weights has to say of them."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any, Self

from torch import nn

from sphericalvision.core import ArgumentError

__all__ = ["RemembersArguments"]


class RemembersArguments(nn.Module):
    """A module that remembers the arguments of its constructor, without a line about them in its class.

    Examples:
        >>> class Scaled(RemembersArguments):
        ...     def __init__(self, factor, *, offset=0.0):
        ...         super().__init__()
        >>> Scaled(2).hyperparameters
        {'factor': 2, 'offset': 0.0}
        >>> Scaled(2)
        Scaled(factor=2, offset=0.0)
    """

    _arguments: dict[str, Any]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Note the constructor's arguments, before the constructors of the class and its bases run."""
        net = super().__new__(cls)
        try:
            bound = inspect.signature(cls.__init__).bind(net, *args, **kwargs)
        except TypeError:
            return (
                net  # a copy is made without arguments and gets these with its state; or __init__ will raise
            )
        bound.apply_defaults()
        arguments = dict(list(bound.arguments.items())[1:])
        for parameter in inspect.signature(cls.__init__).parameters.values():
            if parameter.kind is inspect.Parameter.VAR_KEYWORD:
                arguments |= arguments.pop(parameter.name)
        object.__setattr__(net, "_arguments", arguments)
        return net

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """Plain values that rebuild this network, ``type(net)(**net.hyperparameters)``: what it was constructed with.

        Raises:
            ArgumentError: if it was constructed with something else than plain values.
        """
        return {name: _plain(name, value) for name, value in self._arguments.items()}

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={value}" for name, value in self._arguments.items())


def _plain(name: str, value: Any) -> Any:
    """The value of a hyper-parameter as a file can hold it."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Mapping):
        return {str(key): _plain(name, item) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [_plain(name, item) for item in value]
    raise ArgumentError(
        f"{name}: expected plain values (numbers, text, None, lists of them), which files can hold, "
        f"got {type(value).__name__}"
    )
