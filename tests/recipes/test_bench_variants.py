# SPDX-License-Identifier: Apache-2.0
"""Networks of the configuration side by side in the benchmark."""

from __future__ import annotations

from pathlib import Path

import pytest
from hydra import compose, initialize_config_module
from omegaconf import DictConfig

from sphericalvision.core import ArgumentError
from sphericalvision.recipes.benchmark import variants as bench_variants
from sphericalvision.recipes.benchmark.command import benchmark


def config(*overrides: str) -> DictConfig:
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        return compose("benchmark", ["groups=[variants]", "settings=[[3,4]]", "seconds=0.0", *overrides])


def test_real_time_network_needs_a_twentieth_of_the_arithmetic() -> None:
    paper, real_time = (
        bench_variants.gflop(bench_variants.variant(name, 7, 32))
        for name in ("icosweepnet", "icosweepnet_rt")
    )
    assert paper == pytest.approx(2264, abs=1)  # as counted for the authors' network, every tap
    assert paper / real_time > 20


def test_variants_stand_side_by_side(tmp_path: Path) -> None:
    rows = benchmark(config("variants=[icosweepnet,icosweepnet_rt]"), tmp_path)
    assert [row.name for row in rows] == ["icosweepnet", "icosweepnet_rt"]
    assert "icosweepnet: 1,380,224 parameters" in rows[0].comparison.note


def test_unknown_variants_are_named(tmp_path: Path) -> None:
    for name, what in (("icosweepnet_huge", "icosweepnet_rt"), ("sphere_classifier", "is no IcoSweepNet")):
        with pytest.raises(ArgumentError, match=what):
            benchmark(config(f"variants=[{name}]"), tmp_path)
