# SPDX-License-Identifier: Apache-2.0
"""RomniStereo against numbers of its authors' implementation, and their files."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from sphericalvision.cameras import ring_rig
from sphericalvision.core import FileFormatError
from sphericalvision.losses import depth_index_huber
from sphericalvision.models import RomniStereo, load_romnistereo_checkpoint
from sphericalvision.models.romnistereo import at_hypotheses
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.models.weights.romnistereo_checkpoint import PREFIXES
from sphericalvision.sweep.panorama_sweep import PanoramaTables

OPTIONS = {"base_channel": 2, "num_invdepth": 16, "use_rgb": False, "num_downsample": 1, "corr_levels": 4}


def small() -> RomniStereo:
    torch.manual_seed(0)
    net = RomniStereo(16, feature_channels=2, output_size=(16, 64), iterations=3)
    for part in net.modules():
        if isinstance(part, torch.nn.BatchNorm2d):
            part.running_mean.normal_(std=0.1)  # type: ignore[union-attr, operator]
    return net.eval()


def authors_names(net: RomniStereo) -> dict[str, torch.Tensor]:
    """The weights as the authors' release has them, with the offset before each normalisation that ours leave out."""
    state = {}
    for name, tensor in net.state_dict().items():
        theirs = max(
            (t for t, ours in PREFIXES.items() if name.startswith(f"{ours}.")), key=lambda t: len(PREFIXES[t])
        )
        rest = name.removeprefix(PREFIXES[theirs])
        if rest.startswith((".0.", ".1.")) and theirs.startswith(("encoder", "state_conv")):
            rest = {"0": ".conv", "1": ".bn"}[rest[1]] + rest[2:]
        state[f"module.{theirs}{rest}"] = tensor
        if rest == ".bn.running_mean":
            state[f"module.{theirs}.conv.bias"] = offset = torch.full_like(tensor, 0.25)
            state[f"module.{theirs}{rest}"] = tensor + offset
    return state


@torch.no_grad()
def test_every_stage_is_that_of_the_authors(golden: Path, tmp_path: Path) -> None:
    numbers = torch.load(golden / "romnistereo.pt", weights_only=True)
    path = tmp_path / "theirs.pth"
    torch.save({"net_state_dict": numbers["state_dict"], "net_opts": numbers["options"]}, path)
    net = load_romnistereo_checkpoint(path, output_size=(16, 64))
    net.iterations = numbers["iterations"]
    features = net.features(numbers["images"].flatten(0, 1))[None]
    torch.testing.assert_close(features, numbers["features"], rtol=0, atol=1e-5)
    grid = numbers["grids"].permute(0, 3, 1, 2, 4)  # theirs has the hypotheses last
    tables = PanoramaTables(grid, grid[..., 0] > -2, tuple(numbers["images"].shape[-2:]))
    reference, target = net.volumes(features, tables)
    torch.testing.assert_close(reference, numbers["reference"], rtol=0, atol=1e-5)
    torch.testing.assert_close(target, numbers["target"], rtol=0, atol=1e-5)
    indices = torch.stack(net.refined(reference, target), 1)
    torch.testing.assert_close(indices, numbers["predictions"][:, :, 0], rtol=0, atol=1e-5)
    index = net.predict(numbers["images"], tables).index
    torch.testing.assert_close(index, numbers["test_mode"][:, 0], rtol=0, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize(
    "options", [dict, lambda **values: argparse.Namespace(**values)], ids=["plain", "object"]
)
def test_checkpoints_of_the_authors(tmp_path: Path, options: Callable[..., Any]) -> None:
    net, path = small(), tmp_path / "theirs.pth"
    torch.save({"epoch": 3, "net_state_dict": authors_names(net), "net_opts": options(**OPTIONS)}, path)
    again = read_network(path)
    assert isinstance(again, RomniStereo)
    again = again.with_changes(output_size=(16, 64), iterations=3)
    rig, images = ring_rig(4, image_size=(24, 30)), torch.rand(1, 4, 3, 24, 30)
    torch.testing.assert_close(again(images, rig), net(images, rig), rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"net_opts": OPTIONS | {"encoder_downsample_twice": True}}, "encoder_downsample_twice"),
        ({"net_opts": OPTIONS | {"num_invdepth": 7}}, "num_hypotheses"),
        ({"net_opts": {}}, "num_invdepth"),
        ({"net_opts": OPTIONS | {"base_channel": 4}}, "fit RomniStereo"),
        ({"net_state_dict": {"module.foreign.weight": torch.ones(1)}}, "foreign.weight"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, change: dict[str, Any], named: str) -> None:
    path = tmp_path / "theirs.pth"
    torch.save({"net_state_dict": authors_names(small()), "net_opts": OPTIONS} | change, path)
    with pytest.raises(FileFormatError, match=named):
        read_network(path)


class Harmful:
    """What pickle would run when it is read."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return Path.touch, (Path("harmed"),)  # type: ignore[return-value]


def test_no_code_of_a_file_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"net_state_dict": authors_names(small()), "net_opts": Harmful()}, "theirs.pth")
    with pytest.raises(FileFormatError, match=r"theirs\.pth"):
        load_romnistereo_checkpoint("theirs.pth")
    assert not Path("harmed").exists()


def test_every_iteration_is_trained_and_the_last_most() -> None:
    net, rig = small().train(), ring_rig(4, image_size=(24, 30))
    target, valid = torch.full((1, 16, 64), 5.0), torch.ones(1, 16, 64, dtype=torch.bool)
    images = 2 * torch.rand(1, 4, 3, 24, 30) - 1
    calls: list[float] = []

    def loss(*given: torch.Tensor) -> torch.Tensor:
        value = depth_index_huber(*(part.flatten(1) for part in given))
        calls.append(float(value.detach()))
        return value

    total = net.training_loss(images, rig, None, target, valid, loss)
    weights = [0.9**10, 0.9**5, 1]
    torch.testing.assert_close(float(total.detach()), sum(w * x for w, x in zip(weights, calls, strict=True)))


def test_training_finds_a_depth() -> None:
    """A few steps on one sample bring the index near the truth."""
    net, rig = small().train(), ring_rig(4, image_size=(24, 30))
    target, valid = torch.full((1, 16, 64), 5.0), torch.ones(1, 16, 64, dtype=torch.bool)
    images = 2 * torch.rand(1, 4, 3, 24, 30, generator=torch.Generator().manual_seed(0)) - 1
    tables, optimizer = net.tables(rig), torch.optim.Adam(net.parameters(), 3e-3)

    def absolute(index: torch.Tensor, truth: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
        return (index - truth)[where].abs().mean()

    errors = []
    for _ in range(40):
        optimizer.zero_grad()
        error = net.training_loss(images, tables, None, target, valid, absolute)
        error.backward()
        optimizer.step()
        errors.append(float(error.detach()))
    assert errors[-1] < 0.3 * errors[0]


def test_between_and_beyond_hypotheses() -> None:
    values = torch.tensor([2.0, 4.0, 8.0]).view(1, 1, 1, 1, 3)
    index = torch.tensor([-5.0, -0.5, 0.0, 1.25, 2.0, 2.5, 9.0]).view(1, 1, 1, 7)
    expected = torch.tensor([0.0, 1.0, 2.0, 5.0, 8.0, 4.0, 0.0])
    torch.testing.assert_close(at_hypotheses(values, index).flatten(), expected)
