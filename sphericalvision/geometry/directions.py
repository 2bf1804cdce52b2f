# SPDX-License-Identifier: Apache-2.0
"""Directions on the unit sphere and angles whose derivatives stay finite everywhere.

Convention:
    x right, y down, z forward. Longitude 0 is forward (+z) and grows to the right (+x is +π/2);
    latitude is +π/2 straight up, which is (0, −1, 0).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from sphericalvision.core import ArgumentError
from sphericalvision.kernels import prefer_fused
from sphericalvision.shapes import check_shapes

HALF = (torch.float16, torch.bfloat16)


def components(vectors: Float[Tensor, "*batch n"]) -> tuple[Float[Tensor, "*batch"], ...]:
    """The components of ``vectors`` (*, n), each (*) and contiguous.

    On a CPU most functions of every n-th number take several times as long as of numbers in a row.

    Examples:
        >>> [component.tolist() for component in components(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))]
        [[1.0, 3.0], [2.0, 4.0]]
    """
    return tuple(component.contiguous() for component in vectors.unbind(-1))


def from_components(*parts: Float[Tensor, " ..."]) -> Float[Tensor, "*batch n"]:
    """Vectors (*, n) of n components, each (*) or broadcastable to it: the undoing of ``components``.

    ``torch.stack`` along the last dimension, which is slow on a CPU, where no derivative is asked for in a fraction of
    its time.

    Examples:
        >>> from_components(torch.tensor([1.0, 3.0]), torch.tensor([2.0, 4.0]))
        tensor([[1., 2.],
                [3., 4.]])
    """
    if torch.compiler.is_compiling() or any(part.requires_grad for part in parts):
        return torch.stack(torch.broadcast_tensors(*parts), dim=-1)
    if len(parts) == 2 and parts[0].dtype in (torch.float32, torch.float64):
        return torch.view_as_real(torch.complex(*parts))  # written in one go
    like = functools.reduce(torch.add, parts)  # of their common shape, and batched by vmap if one of them is
    vectors = like.new_empty((*like.shape, len(parts)))
    for index, part in enumerate(parts):
        vectors[..., index] = part
    return vectors


def unit_directions(
    x: Float[Tensor, "*#batch"], y: Float[Tensor, "*#batch"], z: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch 3"]:
    """(x, y, z), each (*) and not all 0, scaled to unit length, (*, 3).

    Examples:
        >>> unit_directions(torch.tensor(0.0), torch.tensor(0.0), torch.tensor(2.0)).tolist()
        [0.0, 0.0, 1.0]
    """
    shrink = torch.addcmul(torch.addcmul(x * x, y, y), z, z).rsqrt()
    return from_components(x * shrink, y * shrink, z * shrink)


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """What ``torch.broadcast_shapes`` returns, but that imports SymPy when first called, half a second.

    Raises:
        RuntimeError: the shapes do not broadcast.

    Examples:
        >>> broadcast_shapes((3, 1), (4,), ())
        torch.Size([3, 4])
    """
    number = torch.empty(())
    return torch.broadcast_tensors(number, *(number.expand(tuple(shape)) for shape in shapes))[0].shape


def has_numbers(tensor: Shaped[Tensor, " ..."]) -> bool:
    """Whether the numbers of a tensor can be looked at: not on the meta device, nor under a compiler or ``vmap``.

    Examples:
        >>> has_numbers(torch.ones(3)), has_numbers(torch.ones(3, device="meta"))
        (True, False)
    """
    traced = torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active()
    return not (tensor.is_meta or traced)


def holds(condition: Bool[Tensor, " ..."]) -> bool:
    """Whether a condition is True everywhere, or cannot be looked at: see ``has_numbers``.

    Examples:
        >>> holds(torch.tensor([True, False])), holds(torch.zeros(2, dtype=torch.bool, device="meta"))
        (False, True)
    """
    return not has_numbers(condition) or bool(condition.all())


@check_shapes
def check_directions(directions: Float[Tensor, "*batch 3"]) -> None:
    """Raise unless ``directions`` are ``(*, 3)``, floating point and finite: all others lie in no cell of a grid.

    Examples:
        >>> check_directions(torch.eye(3))
    """
    if not holds(directions.isfinite()):
        raise ArgumentError(
            "directions: expected numbers, got NaN or infinity; leave these out, no value is nearest to them"
        )


def in_single_precision(numbers: Float[Tensor, " ..."]) -> Float[Tensor, " ..."]:
    """Return numbers in half precision in float32, in which geometry is computed at least, and others as they are.

    Examples:
        >>> in_single_precision(torch.zeros(2, dtype=torch.float16)).dtype
        torch.float32
    """
    return numbers.float() if numbers.dtype in HALF else numbers


def safe_sqrt(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Square root of ``x`` (*), with value and derivative 0 where ``x`` is not positive.

    Examples:
        >>> safe_sqrt(torch.tensor([4.0, 0.0, -1.0])).tolist()
        [2.0, 0.0, 0.0]
    """
    tiny = torch.finfo(x.dtype).tiny
    return x.clamp_min(tiny).sqrt() - math.sqrt(tiny)


def safe_hypot(x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Length of (x, y), shape (*), with derivative 0 instead of NaN at the origin.

    Examples:
        >>> safe_hypot(torch.tensor(3.0), torch.tensor(4.0)).item()
        5.0
    """
    origin = (x == 0) & (y == 0)
    return torch.where(origin, 0.0, torch.hypot(torch.where(origin, 1.0, x), y))


def lifted_radius(
    x: Float[Tensor, "*batch"], y: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """``hypot(x, y)`` (*) of points, kept off 0 by so little that a lens does not notice.

    A lens model divides by it: u = x f(θ) / radius with θ = atan2(radius, z). Lifted, the quotient f(θ) / radius and
    its first two derivatives stay finite everywhere. In front of the camera the lift is √ε/8 of z, which changes the
    quotient by less than rounding does, because it depends on the square of the radius; behind it is ε of z. Points
    shorter than 1e-9 in float32 (1e-80 in float64) are taken for the camera's centre.

    Examples:
        >>> x = torch.zeros(1, requires_grad=True)
        >>> radius = lifted_radius(x, torch.zeros(1), torch.ones(1))
        >>> pixel = 100 * x * torch.atan2(radius, torch.ones(1)) / radius
        >>> round(torch.autograd.grad(pixel, x)[0].item(), 4)
        100.0
    """
    limits = torch.finfo(z.dtype)
    lift = math.sqrt(limits.eps) / 8
    along = torch.nn.functional.leaky_relu(z, limits.eps / lift)
    squared = torch.addcmul(x * x, y, y) + limits.tiny**0.55
    return torch.addcmul(squared, along, along, value=lift * lift).sqrt()


def moderate_lengths(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """``points`` (*, 3) with those scaled to a length around 1 whose squares or products could overflow or vanish.

    All others, between 0.01 mm and three million kilometres, are handed on as they are, to the last bit; in half
    precision they become float32. A zero vector stays zero; infinite ones become NaN, as they have no direction.

    Examples:
        >>> moderate_lengths(torch.tensor([[3.0, 0.0, 4.0], [3e30, 0.0, 4e30], [3e-30, 0.0, 4e-30]])).tolist()[1:]
        [[0.75, 0.0, 1.0], [0.75, 0.0, 1.0]]
    """
    points = in_single_precision(points)
    x, y, z = components(points.detach())
    squared = torch.addcmul(torch.addcmul(x * x, y, y), z, z)
    shortest, longest = 1e-10, 1e19
    # Others do not wait for it
    if not prefer_fused(points.device) and has_numbers(points) and points.numel():
        least, most = squared.aminmax()
        if bool(least > shortest) and bool(most < longest):
            return points
    moderate = (squared > shortest) & (squared < longest)
    largest = torch.maximum(torch.maximum(x.abs(), y.abs()), z.abs())
    tiny = torch.finfo(points.dtype).tiny  # the reciprocals of still shorter ones are infinite
    scale = torch.where(moderate | (largest == 0), 1.0, largest.clamp_min(tiny).reciprocal())
    return points * scale.unsqueeze(-1)


@check_shapes
def normalize(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Scale ``vectors`` (*, 3) to unit length, in float32 at least; a zero vector stays zero.

    Examples:
        >>> normalize(torch.tensor([0.0, 0.0, 2.0])).tolist()
        [0.0, 0.0, 1.0]
    """
    vectors = in_single_precision(vectors)
    x, y, z = components(vectors)
    largest = torch.maximum(torch.maximum(x.detach().abs(), y.detach().abs()), z.detach().abs())
    largest = (largest + (largest == 0)).clamp_min(torch.finfo(vectors.dtype).tiny)
    scale = largest.reciprocal()  # so that squares neither overflow nor vanish
    x, y, z = x * scale, y * scale, z * scale
    shrink = (x * x + y * y + z * z).clamp_min(0.5).rsqrt()
    return from_components(x * shrink, y * shrink, z * shrink)


@check_shapes
def angle_from_axis(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Angle in radians between ``points`` (*, 3) and the optical axis +z, in [0, π], shape (*).

    ``atan2`` keeps small angles exact in float32, where ``acos`` would lose them.

    Examples:
        >>> angle_from_axis(torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])).tolist()
        [0.0, 1.5707963705062866]
    """
    x, y, z = components(in_single_precision(points))
    return torch.atan2(safe_hypot(x, y), z)


def cosine_and_lifted_sinc(
    angle_squared: Float[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """``cos(a)`` and ``sin(a)/a`` from the squared angle (*) in rad², for ``x * sinc`` with x² + y² = c · a².

    Exact to rounding; the derivatives of such products are right at zero, those of ``sinc`` alone are not.

    Examples:
        >>> [value.item() for value in cosine_and_lifted_sinc(torch.tensor(0.0))]
        [1.0, 1.0]
    """
    angle = (angle_squared + torch.finfo(angle_squared.dtype).eps / 64).sqrt()
    return torch.cos(angle), torch.sin(angle) / angle


@check_shapes
def directions_from_longitude_latitude(
    longitude: Float[Tensor, " ..."], latitude: Float[Tensor, " ..."]
) -> Float[Tensor, "*batch 3"]:
    """Unit directions (*, 3) from longitude and latitude (*) in radians.

    Examples:
        >>> quarter = torch.tensor(torch.pi / 2)
        >>> directions_from_longitude_latitude(quarter, torch.tensor(0.0))[0].item()  # to the right is +x
        1.0
        >>> directions_from_longitude_latitude(torch.tensor(0.0), quarter)[1].item()  # up is -y
        -1.0
    """
    longitude, latitude = in_single_precision(longitude), in_single_precision(latitude)
    flat = torch.cos(latitude)  # of as many as there are: a grid has one latitude a row
    return from_components(flat * torch.sin(longitude), -torch.sin(latitude), flat * torch.cos(longitude))


@check_shapes
def longitude_latitude_from_directions(
    directions: Float[Tensor, "*batch 3"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Longitude in [−π, π] and latitude in [−π/2, π/2] (*), radians, of ``directions`` (*, 3) of any length.

    At a pole the longitude is 0. Its derivative, which has no limit there, is 0 within √ε of the poles.

    Examples:
        >>> longitude, latitude = longitude_latitude_from_directions(torch.tensor([0.0, 0.0, 1.0]))
        >>> longitude.item(), latitude.item() == 0
        (0.0, True)
    """
    x, y, z = components(moderate_lengths(directions))
    tiny = torch.finfo(z.dtype).tiny ** 0.5
    squared = torch.addcmul(x * x, z, z)
    is_off_axis = squared > torch.finfo(y.dtype).eps * y * y
    x, z = (torch.where(is_off_axis, side, side.detach()) for side in (x, z))
    longitude = torch.atan2(x, z + (tiny - squared.detach()).clamp_min(0))  # at a pole z is lifted off 0
    return longitude, torch.atan2(-y, (squared + tiny * tiny).sqrt())
