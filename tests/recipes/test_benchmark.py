# SPDX-License-Identifier: Apache-2.0
"""The benchmark measures what it says; how fast things are is not a matter for tests."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_module

from sphericalvision.cameras import ring_rig
from sphericalvision.core import ArgumentError
from sphericalvision.models import IcoSweepNet
from sphericalvision.recipes import bench_cameras
from sphericalvision.recipes.bench_network import comparisons
from sphericalvision.recipes.benchmark import benchmark
from sphericalvision.recipes.benchmarking import Comparison, measure
from sphericalvision.recipes.plain_network import PlainNetwork

TINY = [
    "groups=[machine,network]",
    "settings=[[3,4]]",
    "feature_channels=2",
    "image_size=[32,32]",
    "seconds=0.0",
    "peak_size=128",
]


def config(*overrides: str):  # type: ignore[no-untyped-def]
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        return compose("benchmark", [*TINY, *overrides])


def test_tables_hold_every_comparison(tmp_path: Path) -> None:
    rows = benchmark(config(), tmp_path)
    stored = json.loads((tmp_path / "benchmark.json").read_text())
    assert [row["name"] for row in stored["rows"]] == [row.name for row in rows]
    assert stored["machine"]["torch"] == torch.__version__
    text = (tmp_path / "benchmark.md").read_text()
    for row in rows:
        assert row.title in text
        assert row.seconds > 0
        assert row.rounds >= 3
    inference = {row.name: row for row in rows if "whole inference" in row.title}
    assert inference["plain"].ratio == 1
    assert inference["plain"].gflops is not None


def test_ratio_is_the_reference_time_over_ones_own() -> None:
    runs = {"slow": lambda: time.sleep(0.02), "fast": lambda: time.sleep(0.004)}
    slow, fast = measure(Comparison("sleep", runs, "slow", gflop=0.02), seconds=0.0)
    assert slow.ratio == 1
    assert fast.ratio == pytest.approx(slow.seconds / fast.seconds, rel=0.5)
    assert fast.ratio > 1
    assert slow.gflops == pytest.approx(0.02 / slow.seconds)


def test_stages_that_are_compared_give_the_same_numbers() -> None:
    names = [c.title.split(": ")[1] for c in comparisons(config(), torch.device("cpu"))]
    assert {"features of four cameras", "cost volume", "regulariser", "whole inference"} <= set(names)
    for comparison in comparisons(config(), torch.device("cpu")):
        if "cost volume" in comparison.title:
            plain, ours = (
                comparison.runs["plain"](),
                comparison.runs["sphericalvision"]().values.flatten(1, 2),
            )
            torch.testing.assert_close(ours, plain)
        if "regulariser" in comparison.title or "inference" in comparison.title:
            torch.testing.assert_close(*(run() for run in comparison.runs.values()), rtol=0, atol=1e-4)


def test_the_plain_network_trains_alike(generator: torch.Generator) -> None:
    """Same loss and gradients in float64; float32 differs by what rounding does to batch normalisation."""
    net = IcoSweepNet(3, 4, feature_channels=2, num_cameras=2, shuffle_cameras=False).double().train()
    images = torch.rand(1, 2, 3, 642, generator=generator, dtype=torch.float64)
    tables = net.sweep.tables(ring_rig(2).to(torch.float64))
    gradients = []
    for network in (net, PlainNetwork(net).train()):
        net.zero_grad()
        network(images, tables).square().sum().backward()
        gradients.append([p.grad.clone() for p in net.parameters() if p.grad is not None])
    for ours, plain in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, plain, rtol=1e-6, atol=1e-9)


def test_an_unknown_group_is_refused_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"groups.*network"):
        benchmark(config("groups=[network,speed]"), tmp_path)
    assert not list(tmp_path.iterdir())


def test_bare_formulas_are_those_of_the_camera_models() -> None:
    """Both ways."""
    seen = set()
    for comparison in bench_cameras.comparisons(config("num_points=50"), torch.device("cpu")):
        verb, _, rest = comparison.title.partition(": ")
        if "bare formula" not in comparison.runs or verb not in ("project", "unproject"):
            continue
        answer, valid = comparison.runs["sphericalvision"]()
        tolerance = 1e-2 if verb == "project" else 1e-4
        found = comparison.runs["bare formula"]()
        torch.testing.assert_close(found[valid], answer[valid], atol=tolerance, rtol=0)
        seen.add((verb, rest.split(", 50")[0]))
    assert len([name for verb, name in seen if verb == "project"]) == 13
    assert len([name for verb, name in seen if verb == "unproject"]) == 10


def test_other_libraries_measure_the_same_lens() -> None:
    """Where they answer in pixels, and away from 90°."""
    compared = 0
    for comparison in bench_cameras.comparisons(config("num_points=50"), torch.device("cpu")):
        if not comparison.title.startswith("project") or "float64" not in comparison.title:
            continue
        pixels, valid = comparison.runs["sphericalvision"]()
        for name in {"OpenCV", "kornia", "ds-msp"} & set(comparison.runs):
            answer = comparison.runs[name]()
            found = torch.as_tensor(answer if isinstance(answer, torch.Tensor) else answer[0]).squeeze()
            near = valid & ((pixels - 400).norm(dim=-1) < 300)
            torch.testing.assert_close(found[near], pixels[near], atol=1e-4, rtol=0)
            compared += 1
    assert compared >= 3
