# SPDX-License-Identifier: Apache-2.0
"""One depth map for all images is the best of its kind, and is kept in files."""

from __future__ import annotations

from pathlib import Path

import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.models import ConstantDepth, load_weights, save_weights
from sphericalvision.sweep import index_from_inverse_depth


def test_no_other_map_has_a_smaller_error(tmp_path: Path) -> None:
    """Among the frames' own indices; where no frame knows the depth it is that of the most."""
    generator = torch.Generator().manual_seed(0)
    inverse_depth = 2 * torch.rand(9, 42, generator=generator)
    valid = torch.rand(9, 42, generator=generator) > 0.3
    valid[:, 7] = False
    net = ConstantDepth(3, 8, 0.5).fit(inverse_depth, valid)
    truth = index_from_inverse_depth(inverse_depth, 8, 0.5)

    def error(index: torch.Tensor) -> torch.Tensor:
        return ((index - truth).abs() * valid).sum(0)

    assert all((error(net.index) <= error(other) + 1e-5).all() for other in truth)
    assert net.index[7] == truth[valid].median()
    kept = load_weights(save_weights(net, tmp_path / "constant.safetensors"))
    images = torch.rand(2, 3, 3, 642)
    torch.testing.assert_close(kept(images, ring_rig(3)), net.index.expand(2, -1))


def test_one_depth_all_around() -> None:
    net = ConstantDepth(3, 8, 0.5).fit(torch.tensor([[0.5], [1.0], [2.0]]))
    torch.testing.assert_close(net.index, torch.full((42,), 3.5))
