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
from tests.models.test_one_graph import Operators


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
def test_networks_run_on_the_meta_device_by_as_many_launches_for_any_batch(
    name: str, record_property: Callable[[str, object], None]
) -> None:
    """Shapes alone, with tables made before; what loops over samples would launch more operators for more of them."""
    net = NETWORKS[name].make().eval()
    tables = net.tables(inputs(net, 1)[1]).to("meta")
    net, launches = net.to("meta"), []
    for batch in (2, 3):
        images = inputs(net.to("meta"), batch)[0].to("meta")
        with Operators() as counted:
            index = net(images, tables)
        launches.append(counted.launches)
        assert index.device.type == "meta"
        assert index.shape == (batch, *net.grid.shape)
    print(f"{name}: {launches[0]} operators a forward pass")  # the table of launches: pytest -s
    record_property("operators", launches[0])
    assert launches[0] == launches[1]
