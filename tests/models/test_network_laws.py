# SPDX-License-Identifier: Apache-2.0
"""Every law of ``tests/laws/network_laws.py`` for every network of its table."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from sphericalvision.models import ConstantDepth
from sphericalvision.models.weights import network_names
from sphericalvision.models.weights.registry import network_class
from tests.laws.network_laws import LAWS, NETWORKS, inputs


@torch.no_grad()
@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__.removeprefix("law_"))
def test_law(law: Callable[..., None], name: str, tmp_path: Path) -> None:
    folder = {"folder": tmp_path} if "folder" in inspect.signature(law).parameters else {}
    law(NETWORKS[name], **folder)


def test_every_network_of_the_package_has_an_example() -> None:
    examples = {type(example.make()) for example in NETWORKS.values()}
    examples.add(ConstantDepth)  # looks at nothing, so that laws of images do not hold
    assert {network_class(name) for name in network_names()} <= examples


@pytest.mark.parametrize(
    "name", [name for name in NETWORKS if name.startswith(("icosweep", "omnimvs", "romni"))]
)
def test_networks_run_on_the_meta_device(name: str) -> None:
    """Shapes alone, with tables made before: to count operations, or to look at a network too large for a machine."""
    net = NETWORKS[name].make()
    images, rig = inputs(net, 1)
    tables = net.tables(rig).to("meta")
    index = net.to("meta")(images.to("meta"), tables)
    assert index.device.type == "meta"
    assert index.shape == (1, *net.grid.shape)
