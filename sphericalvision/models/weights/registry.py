# SPDX-License-Identifier: Apache-2.0
"""Networks by name: which class a file of weights means, also one from somebody else's package."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points

from sphericalvision.core import ArgumentError
from sphericalvision.models.base import DepthNetwork
from sphericalvision.models.icosweepnet import IcoSweepNet
from sphericalvision.models.omnimvs import OmniMVS
from sphericalvision.models.refinedsweepnet import RefinedSweepNet
from sphericalvision.models.training_free import SemiGlobalSweep, WinnerTakesAll

__all__ = ["ENTRY_POINTS", "network_class", "network_name", "network_names", "register_network"]

ENTRY_POINTS = "sphericalvision.networks"
"""Group of entry points by which installed packages offer their networks, name = "module:class"."""

_NETWORKS: dict[str, type[DepthNetwork]] = {
    "icosweepnet": IcoSweepNet,
    "omnimvs": OmniMVS,
    "refinedsweepnet": RefinedSweepNet,
    "semi-global-sweep": SemiGlobalSweep,
    "winner-takes-all": WinnerTakesAll,
}


def register_network(name: str, network: type[DepthNetwork]) -> None:
    """Give a class of networks the name by which files of weights know it.

    An installed package does without, by an entry point in its ``pyproject.toml``::

        [project.entry-points."sphericalvision.networks"]
        my-network = "my_package.network:MyNetwork"

    Args:
        name: for instance ``"my-network"``; it stays the same when the class is renamed or moves.
        network: a subclass of ``DepthNetwork`` whose constructor takes plain values.

    Raises:
        ArgumentError: if the class is no ``DepthNetwork``, or the name belongs to another one.

    Examples:
        >>> from sphericalvision.models import load_weights, save_weights
        >>> class Mine(IcoSweepNet):
        ...     "Changes what you like."
        >>> register_network("mine", Mine)
        >>> _ = save_weights(Mine(level=2, num_hypotheses=4, feature_channels=2), "mine.safetensors")
        >>> type(load_weights("mine.safetensors")).__name__
        'Mine'
    """
    if not (isinstance(network, type) and issubclass(network, DepthNetwork)):
        raise ArgumentError(
            f"network: expected a subclass of DepthNetwork for the name {name!r}, got {network!r}"
        )
    known = _NETWORKS.get(name, network)
    if (known.__module__, known.__qualname__) != (network.__module__, network.__qualname__):
        raise ArgumentError(
            f"name: {name!r} is {known.__module__}.{known.__qualname__} already, choose another name for "
            f"{network.__module__}.{network.__qualname__}"
        )
    _NETWORKS[name] = network  # also where the class was defined anew, as when a notebook's cell runs again


def network_names() -> tuple[str, ...]:
    """Return the names of all known networks, those of installed packages included."""
    return tuple(sorted({*_NETWORKS, *(point.name for point in entry_points(group=ENTRY_POINTS))}))


def network_class(name: str) -> type[DepthNetwork]:
    """Return the class of a name.

    Raises:
        ArgumentError: if there is none, or the package that offers it cannot be imported.

    Examples:
        >>> network_class("icosweepnet").__name__
        'IcoSweepNet'
    """
    if name not in _NETWORKS:
        for point in entry_points(group=ENTRY_POINTS, name=name):
            register_network(name, _imported(point))
    if name not in _NETWORKS:
        raise ArgumentError(
            f"name: expected one of {', '.join(map(repr, network_names()))}, got {name!r}; if the network is from "
            "another package, install that, or call register_network"
        )
    return _NETWORKS[name]


def network_name(network: DepthNetwork | type[DepthNetwork]) -> str:
    """Return the name of a network's class.

    Raises:
        ArgumentError: if it has none.

    Examples:
        >>> network_name(OmniMVS)
        'omnimvs'
    """
    wanted = network if isinstance(network, type) else type(network)
    for name, known in _NETWORKS.items():
        if known is wanted:
            return name
    for point in entry_points(group=ENTRY_POINTS):
        # A package that offers the class has been imported, so only its entry points are worth following.
        if (
            point.module.partition(".")[0] == wanted.__module__.partition(".")[0]
            and _imported(point) is wanted
        ):
            register_network(point.name, wanted)
            return point.name
    raise ArgumentError(
        f"network: {wanted.__module__}.{wanted.__qualname__} has no name by which a file could say which network its "
        f"weights are of; call register_network, or add an entry point of the group {ENTRY_POINTS} to its package"
    )


def _imported(point: EntryPoint) -> type[DepthNetwork]:
    try:
        return point.load()  # type: ignore[no-any-return]
    except (ImportError, AttributeError) as error:
        package = point.dist.name if point.dist else point.module
        raise ArgumentError(
            f"name: {point.name!r} is {point.value} of the package {package}, which cannot be imported: {error}"
        ) from error
