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
from sphericalvision.core import ArgumentError
from sphericalvision.data import SampleView, ToSphere, collate_samples
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork, SemiGlobalSweep, WinnerTakesAll
from sphericalvision.models.depth_network import DepthEstimate
from sphericalvision.recipes.commands.evaluate import _masks
from sphericalvision.recipes.evaluation.loop import (
    SampleFrames,
    VertexErrors,
    evaluate,
    mean_errors_by_method,
)
from sphericalvision.recipes.evaluation.methods import Answer, AsUsed, Method, Scale, camera_images
from sphericalvision.sweep import inverse_depth_from_index
from tests.recipes.tiny import TINY_SCENES, Run
from tests.worlds import scenes as world_scenes

NET = SemiGlobalSweep(4, 16, 0.55, depth_coarsening=2)


def batch(rig: CameraRig, scenes: int = 2) -> dict[str, Any]:
    scenes_seen = world_scenes(rig, scenes, view=SampleView(4, 2, images=True, antialias=True))
    samples = collate_samples([scenes_seen[n] for n in range(scenes)])
    # The bytes that a predictor sees, looked up without another rounding
    to_sphere = ToSphere(4, antialias=True)
    looked_up = [to_sphere.images(images, rig) for rig, images in camera_images(samples)]
    return {**samples, "images": torch.stack(looked_up)}


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


def index(method: Method, batch: dict[str, Any]) -> torch.Tensor:
    """What a method says at the vertices of a batch's truth, NaN where it says nothing."""
    vertices, net = Icosphere(2).vertices, method.net
    found, known = method(batch).index_at(vertices, Scale(net.num_hypotheses, net.min_depth))
    return found.where(known, math.nan)


def as_used(
    net: DepthNetwork, batch: dict[str, Any], preparation: Preparation = AS_IT_IS, **options: Any
) -> torch.Tensor:
    options = {"min_depth": 0.55, **options}
    return index(AsUsed("net", net, preparation=preparation, **options), batch)


def test_a_predictor_says_what_the_network_says(frames: dict[str, Any]) -> None:
    torch.testing.assert_close(as_used(NET, frames), index(Method("net", NET), frames), atol=2e-3, rtol=0)


def test_compensation_takes_out_an_exposure(frames: dict[str, Any]) -> None:
    dark = frames | {"fisheye": frames["fisheye"].clone()}
    dark["fisheye"][:, 1] = ((frames["fisheye"][:, 1] + 1) * 0.5 - 1) * frames["fisheye_seen"][:, 1, None]
    net = WinnerTakesAll(4, 16)  # compares colours as they are
    truth = as_used(net, frames)
    wrong, right = (
        float((as_used(net, dark, one) - truth).abs().mean())
        for one in (AS_IT_IS, replace(AS_IT_IS, photometric=True))
    )
    assert right < 0.7 * wrong


def test_a_rig_that_is_turned_is_turned_back() -> None:
    rig = ring_rig(4, image_size=(192, 192))
    frame = batch(rig, 1)
    turned = rig.rotated(tilt=torch.tensor([0.0, math.radians(1.5), 0.0, math.radians(-1.5)]))
    wrong = frame | {"rig": CameraRig.stack([turned])}
    truth = as_used(NET, frame)
    untouched, aligned = (
        float((as_used(NET, wrong, one) - truth).abs().mean()) for one in (AS_IT_IS, Preparation())
    )
    assert aligned < 0.7 * untouched


def test_another_nearest_hypothesis_gives_errors_in_the_hypotheses_of_the_network(
    frames: dict[str, Any],
) -> None:
    given = as_used(Constant(), frames, min_depth=1.0)
    torch.testing.assert_close(given, torch.ones_like(given))  # index 2 from 1 m is index 1 from 0.5 m
    nearer = as_used(Constant(), frames, min_depth=0.1)
    torch.testing.assert_close(nearer, torch.full_like(nearer, 7.0))  # nearer than the nearest


def test_hypotheses_of_a_comparison_are_those_of_one_depth(frames: dict[str, Any]) -> None:
    """Index 2 of 8 from 0.5 m is 1.75 m away: index 4.4 of 12 from 0.7 m, (12 - 1) * 0.7 / 1.75."""
    found, known = Method("net", Constant())(frames).index_at(Icosphere(2).vertices, Scale(12, 0.7))
    assert known.all()
    torch.testing.assert_close(found, torch.full_like(found, 4.4))


def test_masks_reach_the_network(frames: dict[str, Any]) -> None:
    def masked(rig: CameraRig) -> CameraRig:
        masks = {name: torch.zeros(96, 96, dtype=torch.bool) for name in rig.names[1:]}
        return CameraRig(rig.cameras, rig.world_from_camera, masks)

    assert (as_used(NET, frames) - as_used(NET, frames, masked=masked)).abs().mean() > 0.1


def test_a_body_is_looked_for_in_the_frames_of_one_rig(frames: dict[str, Any]) -> None:
    rig = frames["rig"].select(0)
    with pytest.raises(ArgumentError, match=r"^masks: .* one rig"):
        _masks([frames, frames | {"rig": CameraRig.stack([rig, rig.rotated(tilt=0.1)])}])


def in_batches(*batches: dict[str, Any]) -> SampleFrames:
    return SampleFrames(lambda numbers: batches, sum(len(batch["valid"]) for batch in batches))


def test_errors_of_confident_points_say_how_many_they_are(frames: dict[str, Any]) -> None:
    net = Constant()
    some, everything = (Method(str(least), net, least) for least in (0.6, 0.0))
    measure = VertexErrors(Scale(8, 0.5), 2)
    errors = mean_errors_by_method(evaluate([some, everything], in_batches(frames), measure))
    north = index(some, frames).isfinite()
    expected = (100 * (north & frames["valid"]).sum(-1) / frames["valid"].sum(-1)).mean()
    assert errors["0.6"]["kept"] == pytest.approx(float(expected))
    assert errors["0.0"]["kept"] == 100
    assert 20 < errors["0.6"]["kept"] < 80
    alone = mean_errors_by_method(evaluate([everything], in_batches(frames), measure))
    assert "kept" not in alone["0.0"]


def test_errors_count_where_the_truth_does_and_the_method_says_something() -> None:
    """Numbers by hand: of three points with a truth two are said, one of them off by one hypothesis of eight."""
    depth = DepthEstimate(
        torch.tensor([[1.0, 2, 3, 7]]), torch.tensor([[1.0, 0.5, 0.4, 1]]), torch.ones(1, 4) > 0
    )
    answer = Answer(Constant(), depth, min_confidence=0.5)
    answer._look_up = lambda values, directions: (values, torch.ones(4) > 0)  # type: ignore[method-assign]
    truth = inverse_depth_from_index(torch.tensor([[1.0, 3, 0, 2]]), 8, 0.5)
    counts = torch.tensor([[True, True, True, False]])
    errors = VertexErrors(Scale(8, 0.5), 1).errors(answer, (truth, counts, ["a"]))
    assert float(errors["points"]["kept"]) == pytest.approx(100 * 2 / 3)
    assert float(errors["errors"]["MAE"]) == pytest.approx(100 * 0.5 / 8)


def test_frames_that_are_recorded_are_not_asked_for_again(frames: dict[str, Any], tmp_path: Path) -> None:
    """Records are kept as files; another key, or a damaged file, is measured anew."""
    measure, methods = VertexErrors(Scale(8, 0.5), 2), [Method("net", Constant())]
    asked = []

    def samples(key: int) -> SampleFrames:
        return SampleFrames(lambda numbers: asked.append(numbers) or [frames], 2, key={"n": key})  # type: ignore[func-returns-value]

    first = evaluate(methods, samples(1), measure, tmp_path)["net"]
    assert list(first.frames) == ["0", "1"]
    again = evaluate(methods, samples(1), measure, tmp_path)["net"]
    assert again.means == first.means
    assert asked == [[0, 1]]
    evaluate(methods, samples(2), measure, tmp_path)
    assert len(asked) == 2
    (tmp_path / "records/evaluating/net.json").write_text("{")
    evaluate(methods, samples(2), measure, tmp_path)
    assert len(asked) == 3


def test_the_command_evaluates_as_predict_predicts(run: Run, failing: Run, tmp_path: Path) -> None:
    """And writes no table where nothing is confident enough."""
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
    assert errors["used"]["MAE"] == pytest.approx(errors["plain"]["MAE"], rel=0.15)
    assert 0 < errors["scene"]["kept"] < 100
    assert errors["scene"]["MAE"] != errors["plain"]["MAE"]
    message = failing("evaluate", *words, "min_confidence=1.0", "output=none")
    assert "min_confidence=1: icosweepnet-small" in message
    assert not (tmp_path / "none/metrics.json").exists()


def test_further_methods_see_the_same_frames(run: Run, tmp_path: Path, failing: Run, weights: Path) -> None:
    words = "checkpoint=weights.safetensors", "device=cpu", *TINY_SCENES, "data.cache_dir=null"
    weights.with_name("other.safetensors").write_bytes(weights.read_bytes())
    run("evaluate", *words, "methods=[semi-global-sweep,other.safetensors]", "output=out")
    errors = json.loads((tmp_path / "out/metrics.json").read_text())
    assert list(errors) == ["weights", "semi-global-sweep", "other"]
    assert errors["other"] == errors["weights"] != errors["semi-global-sweep"]
    assert "weights is given twice" in failing("evaluate", *words, "methods=[weights.safetensors]")
