# SPDX-License-Identifier: Apache-2.0
"""What is kept beside rendered samples is made anew when it would differ, and only then."""

from __future__ import annotations

from pathlib import Path

import torch

from sphericalvision.models import IcoSweepNet, RefinedSweepNet
from sphericalvision.models.refinedsweepnet import PRIOR
from sphericalvision.recipes.datamodules.random_rigs import RandomRigDataModule, fingerprint
from tests.worlds import RANDOM_RIGS

LEVEL = 4


def network(widths: tuple[int, ...] = (4, 4), level: int = LEVEL, seed: int = 0) -> RefinedSweepNet:
    torch.manual_seed(seed)
    prior = IcoSweepNet(LEVEL, 16, num_cameras=2, **PRIOR)
    return RefinedSweepNet.around(prior, level=level, widths=widths, blocks=1)


def test_clues_are_kept_for_networks_of_other_widths(tmp_path: Path) -> None:
    folders = []
    for net in (network(), network((6, 4))):
        data = RandomRigDataModule(
            world=RANDOM_RIGS, image_size=(32, 32), num_train=1, cache_dir=str(tmp_path)
        )
        data.bind_network(net)
        assert data.plain("train")[0]["fixed"]
        folders.append(sorted(path.name for path in tmp_path.rglob("fixed-*")))
    assert len(folders[0]) == 1
    assert folders[0] == folders[1]


def test_clues_of_another_prior_or_level_are_others() -> None:
    usual = fingerprint(network())
    assert usual == fingerprint(network((6, 4)))
    assert usual != fingerprint(network(seed=1))
    assert usual != fingerprint(network(level=LEVEL + 1))
