# SPDX-License-Identifier: Apache-2.0
"""Networks by name: which class a file of weights means, also one from somebody else's package."""

from __future__ import annotations

from sphericalvision.core import ArgumentError
from sphericalvision.extensions import Registry
from sphericalvision.models.depth_network import DepthNetwork

ENTRY_POINTS = "sphericalvision.networks"
"""Group of entry points by which installed packages offer their networks, name = "module:class"."""

NETWORKS: Registry[type[DepthNetwork]] = Registry(
    "network",
    "a subclass of DepthNetwork",
    lambda name, network: isinstance(network, type) and issubclass(network, DepthNetwork),
    ENTRY_POINTS,
    folder="sphericalvision.models",
)


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
        >>> from sphericalvision.models import IcoSweepNet, load_weights, save_weights
        >>> class Mine(IcoSweepNet):
        ...     "Changes what you like."
        >>> register_network("mine", Mine)
        >>> _ = save_weights(Mine(level=2, num_hypotheses=4, feature_channels=2), "mine.safetensors")
        >>> type(load_weights("mine.safetensors")).__name__
        'Mine'
    """
    NETWORKS.add(name, network)


def network_names() -> tuple[str, ...]:
    """Return the names of all known networks, those of installed packages included."""
    return NETWORKS.names()


def network_class(name: str) -> type[DepthNetwork]:
    """Return the class of a name.

    Raises:
        ArgumentError: if there is none, or the package that offers it cannot be imported.

    Examples:
        >>> network_class("icosweepnet").__name__
        'IcoSweepNet'
    """
    network = NETWORKS.find(name)
    if network is None:
        raise ArgumentError(
            f"name: expected one of {', '.join(map(repr, network_names()))}, got {name!r}; if the network is from "
            "another package, install that, or call register_network"
        )
    return network


def network_name(network: DepthNetwork | type[DepthNetwork]) -> str:
    """Return the name of a network's class.

    Raises:
        ArgumentError: if it has none.

    Examples:
        >>> from sphericalvision.models import OmniMVS
        >>> network_name(OmniMVS)
        'omnimvs'
    """
    kind = network if isinstance(network, type) else type(network)
    name = NETWORKS.name_of(kind)
    if name is None:
        raise ArgumentError(
            f"network: {kind.__module__}.{kind.__qualname__} has no name by which a file could say which network "
            f"its weights are of; call register_network, or add an entry point of the group {ENTRY_POINTS} to its "
            "package"
        )
    return name
