# SPDX-License-Identifier: Apache-2.0
"""``Preparation``: what the keys of commands become."""

from __future__ import annotations

import pytest
import torch
from hydra import compose, initialize_config_module

from sphericalvision.cameras import ring_rig
from sphericalvision.capture.preparation.preparation import AS_IT_IS, Preparation


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), Preparation()),
        (("photometric=false", "align=false"), AS_IT_IS),
        (("preparation=none",), AS_IT_IS),
        (("preparation=none", "align=true", "masks=auto"), Preparation(photometric=False, own_body=True)),
        (("masks='cam{camera}.png'",), Preparation()),
    ],
)
def test_keys_of_predict(words: tuple[str, ...], expected: Preparation) -> None:
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        assert Preparation.from_keys(compose("predict", list(words))) == expected


def test_other_commands_compose_the_same_group_where_they_have_it() -> None:
    with initialize_config_module("sphericalvision.conf", version_base="1.3"):
        assert Preparation.from_keys(compose("evaluate")) == AS_IT_IS
        study = compose("study", ["preset=benchmark", "benchmark.align=false"]).benchmark
        data = compose("train", ["data=capture", "data.photometric=false"]).data
    assert Preparation.from_keys(study) == Preparation(align=False)
    assert Preparation.from_keys(data) == Preparation(photometric=False)


def test_images_are_left_alone_where_nothing_is_asked_for() -> None:
    rig = ring_rig(2, image_size=(32, 32))
    images = {"cam1": torch.full((3, 32, 32), 0.6), "cam2": torch.full((3, 32, 32), 0.3)}
    assert AS_IT_IS.images(rig, images) == images
    even = Preparation().images(rig, images)
    assert abs(float(even["cam1"].mean() - even["cam2"].mean())) < 0.02
