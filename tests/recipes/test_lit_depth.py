# SPDX-License-Identifier: Apache-2.0
"""The training loop's object on its own."""

from __future__ import annotations

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.recipes.lit_depth import DepthModule


@pytest.mark.parametrize("freeze_norm", [False, True])
def test_frozen_norms_keep_their_statistics_and_train_what_evaluation_uses(freeze_norm: bool) -> None:
    module = DepthModule(level=3, num_hypotheses=4, feature_channels=4, freeze_norm=freeze_norm)
    module.net.shuffle_cameras = False
    images = torch.rand(1, 4, 3, num_icosphere_vertices(3), generator=torch.Generator().manual_seed(0))
    rig = ring_rig(4)
    before = {name: value.clone() for name, value in module.net.named_buffers() if "running" in name}
    trained = module.train()(images, rig)
    after = dict(module.net.named_buffers())
    assert all(torch.equal(before[name], after[name]) for name in before) == freeze_norm
    evaluated = module.eval()(images, rig)
    assert torch.allclose(trained, evaluated, atol=1e-5) == freeze_norm
    trained.sum().backward()
    assert all(parameter.grad is not None for parameter in module.parameters())
