# SPDX-License-Identifier: Apache-2.0
"""Muon, an optimiser whose steps turn all directions of a layer's weights equally far."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import Parameter
from torch.optim import AdamW, Optimizer

from sphericalvision.core import ArgumentError

COEFFICIENTS = (3.4445, -4.7750, 2.0315)
"""A polynomial, x (a + b x² + c x⁴), that takes small x away from 0 fast, and leaves it within 0.7 and 1.2."""
ITERATIONS = 5
"""Applications of the polynomial; they take all from a few thousandths on there."""
SIZE = 5.0
"""Largest singular value of a matrix' step, in learning rates: one learning rate suits AdamW's part, too."""


def orthogonalized(matrices: Float[Tensor, "B n m"]) -> Float[Tensor, "B n m"]:
    """Return matrices with the same singular vectors, and singular values of about 1, between 0.7 and 1.2.

    Zeros stay zeros.

    References:
        Björck and Bowie (1971), "An iterative algorithm for computing the best estimate of an orthogonal matrix";
        Jordan et al. (2024), "Muon: an optimizer for hidden layers in neural networks", for the coefficients.

    Examples:
        >>> singular = torch.linalg.svdvals(orthogonalized(torch.rand(3, 4, 9)))
        >>> bool(((singular > 0.6) & (singular < 1.3)).all())
        True
    """
    first, second, third = COEFFICIENTS
    tall = matrices.shape[-2] > matrices.shape[-1]
    values = matrices.mT if tall else matrices  # products are of the shorter side
    values = values / values.norm(dim=(-2, -1), keepdim=True).clamp(min=1e-12)
    for _ in range(ITERATIONS):
        product = values @ values.mT
        factor = torch.baddbmm(product, product, product, beta=second, alpha=third)
        values = torch.baddbmm(values, factor, values, beta=first)
    return values.mT if tall else values


class Muon(Optimizer):
    """Gradient descent with momentum whose steps are made orthogonal; AdamW for what is no matrix, such as biases.

    Weights of a convolution are a matrix of output channels by everything else. Most of a gradient lies in few
    directions; in an orthogonal step all directions have the same length, so the rare ones are learned as well.

    ``torch.optim.Muon`` takes matrices alone, and one after the other. Here all matrices of a shape are one product,
    since small networks have many of them.

    Args:
        params: to be learned, without groups.
        lr: learning rate. The singular values of a matrix' step are five times as large.
        momentum: decay of the running mean of a matrix' gradient.
        betas: decay of the running means of gradient and square of everything else.
        weight_decay: taken off the weights, times the learning rate.

    Raises:
        ArgumentError: parameters come in groups.

    References:
        Jordan et al. (2024), "Muon: an optimizer for hidden layers in neural networks".

    Examples:
        >>> layer = torch.nn.Conv1d(2, 3, 7)
        >>> optimizer = Muon(layer.parameters(), lr=1e-3)
        >>> layer(torch.rand(1, 2, 9)).sum().backward()
        >>> optimizer.step()
    """

    def __init__(
        self,
        params: Iterable[Parameter],
        lr: float = 1e-3,
        momentum: float = 0.95,
        betas: tuple[float, float] = (0.9, 0.999),
        weight_decay: float = 0.0,
    ) -> None:
        parameters = list(params)
        if not all(isinstance(parameter, Tensor) for parameter in parameters):
            raise ArgumentError("params: expected parameters, got groups of them; all have the same settings")
        if not 0 <= momentum < 1:
            raise ArgumentError(f"momentum: expected 0 or more, and less than 1, got {momentum}")
        matrices = [parameter for parameter in parameters if parameter.ndim > 1]
        others = [parameter for parameter in parameters if parameter.ndim <= 1]
        self._adamw = AdamW([{"params": others}], lr, (betas[0], betas[1]), weight_decay=weight_decay)
        groups: list[dict[str, Any]] = [{"params": matrices}, {"params": others}]
        super().__init__(groups, {**self._adamw.defaults, "momentum": momentum})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Take a step."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        matrices, others = self.param_groups
        shapes: dict[tuple[Any, ...], list[Parameter]] = {}
        for parameter in matrices["params"]:
            if parameter.grad is not None:
                key = (parameter.shape, parameter.dtype, parameter.device)
                shapes.setdefault(key, []).append(parameter)
        for alike in shapes.values():
            self._turn(alike, **{name: matrices[name] for name in ("lr", "momentum", "weight_decay")})
        # What was loaded, or set by a schedule, is in this optimiser.
        self._adamw.state, self._adamw.param_groups = self.state, [others]
        self._adamw.step()
        return loss

    def _turn(self, parameters: list[Parameter], lr: float, momentum: float, weight_decay: float) -> None:
        """Step along matrices of one shape."""
        for parameter in parameters:
            if parameter not in self.state:
                self.state[parameter]["mean"] = torch.zeros_like(parameter)
        gradients = [parameter.grad for parameter in parameters]
        means = [self.state[parameter]["mean"] for parameter in parameters]
        torch._foreach_lerp_(means, gradients, 1 - momentum)  # type: ignore[arg-type]
        lookahead = torch.stack(gradients).lerp_(torch.stack(means), momentum)  # type: ignore[arg-type]  # Nesterov's
        matrices = lookahead.flatten(2)  # of output channels by everything else
        size = SIZE * math.sqrt(max(1.0, matrices.shape[1] / matrices.shape[2]))
        steps = orthogonalized(matrices).view_as(lookahead)
        weights: list[Tensor] = list(parameters)
        torch._foreach_mul_(weights, 1 - lr * weight_decay)
        torch._foreach_add_(weights, list(steps), alpha=-lr * size)
