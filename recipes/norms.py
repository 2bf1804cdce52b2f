# SPDX-License-Identifier: Apache-2.0
"""Statistics of BatchNorm, taken anew before a stage of training that freezes them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import torch
from torch import nn

__all__ = ["estimate_norm_statistics", "norms"]


def norms(network: nn.Module) -> Iterator[nn.modules.batchnorm._BatchNorm]:
    """All batch normalisations in a network, planar and crown alike."""
    return (m for m in network.modules() if isinstance(m, nn.modules.batchnorm._BatchNorm))


@torch.no_grad()
def estimate_norm_statistics(network: nn.Module, batches: Iterable[dict[str, Any]]) -> None:
    """Replace the running statistics by plain means over ``batches``; weights and mode stay as they are.

    Running statistics remember about ten batches. With one frame in a batch they tell of ten frames, whichever came
    last, and an evaluation that normalises by them is far off.

    References:
        Wu and Johnson (2021), "Rethinking 'Batch' in BatchNorm", section 3 (PreciseBN).
    """
    was_training, momenta = network.training, [norm.momentum for norm in norms(network)]
    for norm in norms(network):
        norm.reset_running_stats()
        norm.momentum = None  # cumulative mean
    device = next(network.parameters()).device
    network.train()
    for batch in batches:
        network(batch["images"].to(device), batch["rig"].to(device))
    for norm, momentum in zip(norms(network), momenta, strict=True):
        norm.momentum = momentum
    network.train(was_training)
