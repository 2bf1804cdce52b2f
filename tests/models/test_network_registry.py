# SPDX-License-Identifier: Apache-2.0
"""Networks by name: from this package, registered by hand, and from somebody else's package."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from sphericalvision.cameras import ring_rig
from sphericalvision.core import ArgumentError, FileFormatError
from sphericalvision.losses import depth_index_huber
from sphericalvision.models import (
    IcoSweepNet,
    OmniMVS,
    load_weights,
    register_network,
    save_weights,
)
from sphericalvision.models.weights import network_names
from sphericalvision.models.weights.registry import NETWORKS, network_class, network_name

BUILT_IN = network_names()

SOMEBODYS_NETWORK = """
import torch
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork
from sphericalvision.sweep import DepthEstimate


class Flat(DepthNetwork):
    def __init__(self, level=3, num_hypotheses=8, min_depth=0.5, sizes=(1, 2)):
        super().__init__(num_hypotheses, min_depth, num_cameras=2, any_cameras=True)
        self.level, self.grid = level, Icosphere(level)
        self.index = torch.nn.Parameter(torch.zeros(()))

    def predict(self, images, rig, seen=None):
        self.check_images(images)
        index = self.index.expand(len(images), *self.grid.shape)
        return DepthEstimate(index, torch.ones_like(index), torch.ones_like(index, dtype=torch.bool))
"""


def test_a_network_whose_forward_takes_no_hint_trains() -> None:
    class Dim(IcoSweepNet):
        def forward(self, images: torch.Tensor, rig: Any, seen: Any = None) -> torch.Tensor:  # type: ignore[override]
            return super().forward(images / 2, rig, seen)

    net = Dim(3, 4, feature_channels=2).eval()
    images, truth = torch.rand(1, 4, 3, 642), torch.ones(1, *net.grid.shape)
    loss = net.training_loss(images, ring_rig(4), None, truth, truth > 0, depth_index_huber)
    assert loss == depth_index_huber(net(images, ring_rig(4)), truth, truth > 0)


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Make a package with an entry point importable, as pip does."""

    def make(module: str, source: str, **names: str) -> None:
        (tmp_path / f"{module}.py").write_text(source)
        info = tmp_path / f"{module}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
        lines = [f"{name} = {value}" for name, value in names.items()]
        (info / "entry_points.txt").write_text("\n".join(["[sphericalvision.networks]", *lines]))
        monkeypatch.syspath_prepend(tmp_path)

    yield make  # type: ignore[misc]
    for module in ("somebodys", "broken"):
        sys.modules.pop(module, None)
    for name in [name for name in NETWORKS.things if name not in BUILT_IN]:
        if NETWORKS.things[name].__module__ in ("somebodys", __name__):
            del NETWORKS.things[name]


def test_the_names_of_this_package() -> None:
    assert {"icosweepnet", "omnimvs"} <= set(network_names())
    for name in network_names():
        assert network_name(network_class(name)) == name
    assert (network_class("icosweepnet"), network_class("omnimvs")) == (IcoSweepNet, OmniMVS)


def test_somebodys_network_is_found_by_its_entry_point(install: Any, tmp_path: Path) -> None:
    install("somebodys", SOMEBODYS_NETWORK, flat="somebodys:Flat")
    assert "flat" in network_names()
    flat = network_class("flat")
    net = flat(level=2, sizes=(3, 4))
    torch.nn.init.constant_(net.index, 2.5)
    again = load_weights(save_weights(net, tmp_path / "flat.safetensors"))
    assert type(again) is flat
    assert again.hyperparameters == {"level": 2, "num_hypotheses": 8, "min_depth": 0.5, "sizes": [3, 4]}
    assert (again(torch.zeros(1, 2, 3, 162), None) == 2.5).all()


def test_a_name_is_found_for_a_class_that_was_imported_first(install: Any) -> None:
    install("somebodys", SOMEBODYS_NETWORK, flat="somebodys:Flat")
    import somebodys  # type: ignore[import-not-found]

    assert network_name(somebodys.Flat()) == "flat"


def test_a_package_that_cannot_be_imported_is_named(install: Any, tmp_path: Path) -> None:
    install("broken", "import nonesuch", worse="broken:Net")
    with pytest.raises(
        ArgumentError, match="'worse' is broken:Net of the package broken, which cannot be imp"
    ):
        network_class("worse")
    save_file({}, tmp_path / "x.safetensors", {"format": "sphericalvision-worse", "hyperparameters": "{}"})
    with pytest.raises(FileFormatError, match="No module named 'nonesuch'"):
        load_weights(tmp_path / "x.safetensors")


def test_networks_without_a_name_cannot_be_written_until_registered(install: Any, tmp_path: Path) -> None:
    class Mine(IcoSweepNet):
        pass

    net = Mine(3, 4, feature_channels=1)
    with pytest.raises(ArgumentError, match=r"Mine has no name.*register_network"):
        save_weights(net, tmp_path / "mine.safetensors")
    register_network("mine", Mine)
    register_network("mine", Mine)
    assert type(load_weights(save_weights(net, tmp_path / "mine.safetensors"))) is Mine
