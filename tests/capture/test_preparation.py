# SPDX-License-Identifier: Apache-2.0
"""``Preparation``: what the keys of commands become."""

from __future__ import annotations

import pytest
import torch
from hydra import compose, initialize_config_module

from sphericalvision.cameras import ring_rig
from sphericalvision.capture.preparation.preparation import AS_IT_IS, Preparation
from sphericalvision.recipes.app.checks import typed
from sphericalvision.recipes.commands.predict import PredictConfig


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), Preparation()),
        (("photometric=false", "align=false"), AS_IT_IS),
        (("preparation=none",), AS_IT_IS),
        (("preparation=none", "align=true"), Preparation(photometric=False)),
    ],
)
def test_keys_of_predict(words: tuple[str, ...], expected: Preparation) -> None:
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        config = compose("predict", ["calibration=c", "images=x", *words])
    assert typed(PredictConfig, config).preparation == expected


def test_other_commands_compose_the_same_group_where_they_have_it() -> None:
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        evaluation = compose("evaluate")
        benchmark = compose("benchmark", ["align=false"])
        data = compose("train", ["data=capture", "data.photometric=false"]).data
    assert (evaluation.photometric, evaluation.align) == (False, False)
    assert (benchmark.photometric, benchmark.align) == (True, False)
    assert (data.photometric, "align" in data) == (False, False)


def test_images_are_left_alone_where_nothing_is_asked_for() -> None:
    rig = ring_rig(2, image_size=(32, 32))
    images = {"cam1": torch.full((3, 32, 32), 0.6), "cam2": torch.full((3, 32, 32), 0.3)}
    assert AS_IT_IS.images(rig, images) == images
    even = Preparation().images(rig, images)
    assert abs(float(even["cam1"].mean() - even["cam2"].mean())) < 0.02
