# SPDX-License-Identifier: Apache-2.0
"""Statistics of BatchNorm taken anew."""

from __future__ import annotations

import torch
from torch import nn

from sphericalvision.recipes.norms import estimate_norm_statistics, norms


class Network(nn.Module):
    """One norm, called as depth networks are."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(3)

    def forward(self, images: torch.Tensor, rig: torch.Tensor) -> torch.Tensor:
        return self.norm(images + rig)


def test_statistics_become_the_mean_over_batches(generator: torch.Generator) -> None:
    network = Network().eval()
    network.norm.running_mean += 100.0
    images = [torch.randn(8, 3, generator=generator) * k for k in (1, 2, 3)]
    estimate_norm_statistics(network, [{"images": x, "rig": torch.ones(())} for x in images])
    assert torch.allclose(network.norm.running_mean, torch.stack([x.mean(0) + 1 for x in images]).mean(0))
    assert torch.allclose(network.norm.running_var, torch.stack([x.var(0) for x in images]).mean(0))
    assert not network.training
    assert [norm.momentum for norm in norms(network)] == [0.1]
