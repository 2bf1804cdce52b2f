# SPDX-License-Identifier: Apache-2.0
"""Aggregation of the cameras' values at the points of a sweep to one cost volume.

Networks take an aggregation as an object or by name; ``register_aggregation`` names one's own, for files of weights.
"""

from __future__ import annotations

import inspect

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sphericalvision.core import ShapeError, check_choice
from sphericalvision.extensions import Registry
from sphericalvision.sweep.sphere_sweep import SweepVolume


class Aggregation(nn.Module):
    """Base of aggregations: ``forward`` maps a ``SweepVolume`` of C channels to ``(B, out_channels, N, V)``.

    Args:
        out_channels: of the volume that ``forward`` returns.

    Attributes:
        any_cameras: whether it takes any number of cameras, in any order, with the same result.

    Examples:
        The strongest answer among the cameras that see a point, 0 where none does:

        >>> class Strongest(Aggregation):
        ...     def __init__(self, channels):
        ...         super().__init__(out_channels=channels)
        ...     def forward(self, volume):
        ...         values = volume.values.masked_fill(~volume.seen.unsqueeze(2), -torch.inf).amax(1)
        ...         return values.where(volume.seen.any(1, keepdim=True), 0.0)
        >>> volume = SweepVolume(torch.randn(1, 3, 5, 4, 42), torch.ones(1, 3, 4, 42, dtype=torch.bool))
        >>> Strongest(channels=5)(volume).shape
        torch.Size([1, 5, 4, 42])
    """

    any_cameras: bool = True

    def __init__(self, out_channels: int) -> None:
        super().__init__()
        self.out_channels = out_channels

    def forward(self, volume: SweepVolume) -> Float[Tensor, "B C_out N *grid"]:
        """Return the cost volume ``(B, out_channels, N, V)``."""
        raise NotImplementedError(f"{type(self).__name__}.forward")

    def extra_repr(self) -> str:
        return f"out_channels={self.out_channels}"


def aggregate(aggregation: Aggregation, volume: SweepVolume) -> Float[Tensor, "B C_out N *grid"]:
    """Return the cost volume of an aggregation; ``ShapeError`` if it has not ``out_channels`` channels."""
    result: Tensor = aggregation(volume)
    if result.shape[1] != aggregation.out_channels:
        raise ShapeError(
            f"aggregation: {type(aggregation).__name__} has out_channels={aggregation.out_channels}, and its forward "
            f"returned {result.shape[1]} channels, shape {tuple(result.shape)}"
        )
    return result


class Concatenation(Aggregation):
    """The channels of all cameras, one camera after the other: ``(B, n * C, N, V)``, for one number of cameras.

    Args:
        channels: C, of each camera.
        num_cameras: n.
        shuffle: whether training concatenates the cameras in random order, drawn from torch's global generator.

    Raises:
        ShapeError: a volume of another number of cameras.

    References:
        Komatsu et al. (2020), "360° depth estimation from multiple fisheye images with origami crown
        representation of icosahedron", section III-C.

    Examples:
        >>> from sphericalvision.sweep import SweepVolume
        >>> values, seen = torch.rand(1, 3, 8, 4, 42), torch.ones(1, 3, 4, 42, dtype=torch.bool)
        >>> Concatenation(channels=8, num_cameras=3)(SweepVolume(values, seen)).shape
        torch.Size([1, 24, 4, 42])
    """

    any_cameras = False

    def __init__(self, channels: int, num_cameras: int, shuffle: bool = True) -> None:
        super().__init__(num_cameras * channels)
        self.num_cameras, self.shuffle = num_cameras, shuffle

    def forward(self, volume: SweepVolume) -> Float[Tensor, "B C_out N *grid"]:
        values = volume.values
        if values.shape[1] != self.num_cameras:
            raise ShapeError(
                f"volume: expected values of {self.num_cameras} cameras, got {values.shape[1]} "
                f"in shape {tuple(values.shape)}"
            )
        if self.training and self.shuffle:
            # Cameras and channels lie innermost in memory, as channels-last convolutions want them, and stay there.
            innermost = values.movedim((1, 2), (-2, -1))
            order = torch.randperm(self.num_cameras).to(values.device)
            values = innermost.index_select(-2, order).movedim((-2, -1), (1, 2))
        return values.flatten(1, 2)

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, num_cameras={self.num_cameras}, shuffle={self.shuffle}"


class MeanVariance(Aggregation):
    """Mean and variance over the cameras that see a point, and their share: ``mean_and_variance`` as a module.

    Args:
        channels: C, of each camera.

    Examples:
        >>> from sphericalvision.sweep import SweepVolume
        >>> values, seen = torch.rand(1, 3, 8, 4, 42), torch.ones(1, 3, 4, 42, dtype=torch.bool)
        >>> MeanVariance(channels=8)(SweepVolume(values, seen)).shape
        torch.Size([1, 17, 4, 42])
    """

    def __init__(self, channels: int) -> None:
        super().__init__(2 * channels + 1)

    def forward(self, volume: SweepVolume) -> Float[Tensor, "B C_out N *grid"]:
        return mean_and_variance(volume)


def mean_and_variance(volume: SweepVolume) -> Float[Tensor, "B C_out N *grid"]:
    """Return mean and variance over the cameras that see a point, and their share: ``(B, 2 * C + 1, N, V)``.

    The variance is small where the cameras agree. The result does not depend on the order of the cameras, nor its shape
    on their number. It is zero where no camera sees the point.

    References:
        Yao, Luo, Li, Fang and Quan (2018), "MVSNet: depth inference for unstructured multi-view stereo",
        equation 2 (there without masks).

    Examples:
        >>> values = torch.tensor([1.0, 3.0, 0.0]).view(1, 3, 1, 1, 1)  # three cameras, one channel, one point
        >>> seen = torch.tensor([True, True, False]).view(1, 3, 1, 1)
        >>> mean_and_variance(SweepVolume(values, seen)).flatten().tolist()  # mean, variance, share
        [2.0, 1.0, 0.666...]
    """
    values = volume.values
    seen = volume.seen.unsqueeze(2).to(values)
    count = seen.sum(1)
    divisor = count.clamp_min(1)
    # A camera at a time, which takes fewer passes over memory.
    cameras = list(zip(values.unbind(1), seen.unbind(1), strict=True))
    total = values.new_zeros(())
    for value, weight in cameras:
        total = torch.addcmul(total, value, weight)
    mean = total / divisor
    total = values.new_zeros(())
    for value, weight in cameras:
        total = torch.addcmul(total, (value - mean).square(), weight)
    return torch.cat((mean, total / divisor, count / values.shape[1]), 1)


ENTRY_POINTS = "sphericalvision.aggregations"
"""Group of entry points, name -> subclass of ``Aggregation``, in which other packages offer theirs."""

AGGREGATIONS: Registry[type[Aggregation]] = Registry(
    "aggregation",
    "a subclass of Aggregation",
    lambda name, aggregation: isinstance(aggregation, type) and issubclass(aggregation, Aggregation),
    ENTRY_POINTS,
)
AGGREGATIONS.add("concatenation", Concatenation)
AGGREGATIONS.add("variance", MeanVariance)


def register_aggregation(name: str, aggregation: type[Aggregation]) -> None:
    """Register a class of aggregations under a name, for networks and their files of weights.

    Installed packages use the entry points ``sphericalvision.aggregations`` instead.

    Args:
        name: as in ``IcoSweepNet(aggregation=name)``.
        aggregation: its constructor takes any of ``channels``, ``num_cameras`` and ``shuffle``.

    Raises:
        ArgumentError: if the name belongs to another class.

    Examples:
        >>> class FirstCamera(Aggregation):
        ...     def __init__(self, channels):
        ...         super().__init__(out_channels=channels)
        ...     def forward(self, volume):
        ...         return volume.values[:, 0]
        >>> register_aggregation("first-camera", FirstCamera)
        >>> named_aggregation("first-camera", channels=8, num_cameras=4)
        FirstCamera(out_channels=8)
    """
    AGGREGATIONS.add(name, aggregation)


def named_aggregation(
    aggregation: str | Aggregation, channels: int, num_cameras: int, shuffle: bool = False
) -> Aggregation:
    """Return the aggregation of a name; an object is returned as it is.

    Args:
        aggregation: ``"concatenation"``, ``"variance"``, a name of ``register_aggregation``, or an object.
        channels: C, of each camera.
        num_cameras: n.
        shuffle: whether training takes the cameras in random order, where their order matters.

    Raises:
        ArgumentError: an unknown name.

    Examples:
        >>> named_aggregation("variance", channels=32, num_cameras=4)
        MeanVariance(out_channels=65)
        >>> named_aggregation("concatenation", 32, 4).out_channels
        128
    """
    if isinstance(aggregation, Aggregation):
        return aggregation
    factory = AGGREGATIONS.find(aggregation) if isinstance(aggregation, str) else None
    if factory is None:
        check_choice("aggregation", aggregation, AGGREGATIONS.names())
    assert factory is not None
    offered = {"channels": channels, "num_cameras": num_cameras, "shuffle": shuffle}
    parameters = inspect.signature(factory).parameters
    return factory(**{name: value for name, value in offered.items() if name in parameters})
