# SPDX-License-Identifier: Apache-2.0
"""Evaluation of networks as they are used: by way of a ``Predictor``, and of their confident points alone."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture.preparation.preparation import AS_IT_IS, Preparation
from sphericalvision.data import collate_samples
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork, SemiGlobalSweep, WinnerTakesAll
from sphericalvision.models.base import DepthEstimate
from sphericalvision.recipes.evaluation.inputs import PredictorEstimator, VertexEstimator
from sphericalvision.recipes.evaluation.tables import evaluate
from sphericalvision.scenes import SceneDataset
from tests.recipes.tiny import TINY_SCENES, Run

NET = SemiGlobalSweep(4, 16, 0.55, depth_coarsening=2)


def batch(rig: CameraRig, scenes: int = 2) -> dict[str, Any]:
    scenes_seen = SceneDataset(scenes, rig, 4, entries=("sphere", "fisheye"), antialias=True)
    return collate_samples([scenes_seen[n] for n in range(scenes)])


@pytest.fixture(scope="module")
def frames() -> dict[str, Any]:
    return batch(ring_rig(3, image_size=(96, 96)))


class Constant(DepthNetwork):
    """The same index everywhere, with confidence in the northern half alone."""

    def __init__(self, num_hypotheses: int = 8, min_depth: float = 0.5) -> None:
        super().__init__(num_hypotheses, min_depth, num_cameras=1, any_cameras=True)
        self.level, self.grid = 3, Icosphere(1)
        self.index = nn.Parameter(torch.tensor(2.0))

    def predict(self, images: torch.Tensor, rig: Any, seen: Any = None) -> DepthEstimate:
        index = self.index.detach().expand(len(images), *self.grid.shape)
        sure = (self.grid.vertices[:, 1] < 0).expand_as(index)
        return DepthEstimate(index, sure.float(), torch.ones_like(sure))


def test_a_predictor_says_what_the_network_says(frames: dict[str, Any]) -> None:
    as_used = PredictorEstimator(NET, min_depth=0.55, preparation=AS_IT_IS)
    torch.testing.assert_close(as_used(frames), VertexEstimator(NET)(frames), atol=2e-3, rtol=0)


def test_compensation_takes_out_an_exposure(frames: dict[str, Any]) -> None:
    dark = frames | {"fisheye": frames["fisheye"].clone()}
    dark["fisheye"][:, 1] = ((frames["fisheye"][:, 1] + 1) * 0.5 - 1) * frames["fisheye_seen"][:, 1, None]
    net = WinnerTakesAll(4, 16)  # compares colours as they are
    truth = PredictorEstimator(net, min_depth=0.55, preparation=AS_IT_IS)(frames)
    wrong, right = (
        float((PredictorEstimator(net, min_depth=0.55, preparation=one)(dark) - truth).abs().mean())
        for one in (AS_IT_IS, replace(AS_IT_IS, photometric=True))
    )
    assert right < 0.7 * wrong


def test_a_rig_that_is_turned_is_turned_back() -> None:
    rig = ring_rig(4, image_size=(192, 192))
    frame = batch(rig, 1)
    turned = rig.rotated(tilt=torch.tensor([0.0, math.radians(1.5), 0.0, math.radians(-1.5)]))
    wrong = frame | {"rig": CameraRig.stack([turned])}
    truth = PredictorEstimator(NET, min_depth=0.55)(frame)
    untouched, aligned = (
        float((PredictorEstimator(NET, min_depth=0.55, preparation=one)(wrong) - truth).abs().mean())
        for one in (AS_IT_IS, Preparation())
    )
    assert aligned < 0.7 * untouched


def test_another_nearest_hypothesis_gives_errors_in_the_hypotheses_of_the_network(
    frames: dict[str, Any],
) -> None:
    given = PredictorEstimator(Constant(), min_depth=1.0)(frames)
    torch.testing.assert_close(given, torch.ones_like(given))  # index 2 from 1 m is index 1 from 0.5 m
    nearer = PredictorEstimator(Constant(), min_depth=0.1)(frames)
    torch.testing.assert_close(nearer, torch.full_like(nearer, 7.0))  # nearer than the nearest


def test_masks_reach_the_network(frames: dict[str, Any]) -> None:
    def masked(rig: CameraRig) -> CameraRig:
        masks = {name: torch.zeros(96, 96, dtype=torch.bool) for name in rig.names[1:]}
        return CameraRig(rig.cameras, rig.world_from_camera, masks)

    usual = PredictorEstimator(NET, min_depth=0.55)(frames)
    alone = PredictorEstimator(NET, min_depth=0.55, masked=masked)(frames)
    assert (usual - alone).abs().mean() > 0.1


def test_errors_of_confident_points_say_how_many_they_are(frames: dict[str, Any]) -> None:
    net = Constant()
    some, everything = (VertexEstimator(net, least) for least in (0.6, 0.0))
    rows = evaluate({"some": some, "all": everything}, [frames], net)
    kept = [row.values["kept"] for row in rows]
    north = VertexEstimator(net, 0.6)(frames).isfinite()
    expected = (100 * (north & frames["valid"]).sum(-1) / frames["valid"].sum(-1)).mean()
    assert kept == pytest.approx([float(expected), 100.0])
    assert 20 < kept[0] < 80
    (alone,) = evaluate({"all": everything}, [frames], net)
    assert "kept" not in alone.values


def test_the_command_evaluates_as_predict_predicts(run: Run, tmp_path: Path) -> None:
    words = "checkpoint=icosweepnet-small", "model.level=4", "device=cpu", *TINY_SCENES
    for name, more in (
        ("plain", ()),
        ("used", ("photometric=true",)),
        ("scene", ("model.min_depth=scene", "min_confidence=0.7")),
    ):
        run("evaluate", *words, *more, f"output={name}")
    errors = {
        name: json.loads((tmp_path / name / "metrics.json").read_text())["icosweepnet-small"]
        for name in ("plain", "used", "scene")
    }
    assert errors["used"]["MAE"] == pytest.approx(errors["plain"]["MAE"], rel=0.05)
    assert 0 < errors["scene"]["kept"] < 100
    assert errors["scene"]["MAE"] != errors["plain"]["MAE"]


def test_samples_without_images_of_cameras_are_refused_before_anything_is_rendered(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        run("evaluate", "data=random_rigs", "photometric=true", "output=none")
    assert "samples of RandomRigDataModule do not hold" in capsys.readouterr().err


def test_no_table_is_written_where_nothing_is_confident_enough(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = "checkpoint=icosweepnet-small", "model.level=4", "device=cpu", *TINY_SCENES
    with pytest.raises(SystemExit):
        run("evaluate", *words, "min_confidence=1.0", "output=none")
    assert "min_confidence: icosweepnet-small is nowhere as confident as 1" in capsys.readouterr().err
    assert not (tmp_path / "none/metrics.json").exists()
