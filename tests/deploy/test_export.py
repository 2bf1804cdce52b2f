# SPDX-License-Identifier: Apache-2.0
"""Exported programs compute what the predictor computes, on images that they were not exported with."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from sphericalvision import Predictor
from sphericalvision.cameras import CameraRig, FisheyeCamera, ring_rig
from sphericalvision.core import ArgumentError
from sphericalvision.data import make_scene, render_rig
from sphericalvision.deploy.export import (
    RigProgram,
    example_images,
    export_onnx,
    export_program,
    onnx_difference,
    with_constants_folded,
)
from sphericalvision.models import IcoSweepNet

RIG = ring_rig(3, image_size=(24, 30))


def predictor() -> Predictor:
    torch.manual_seed(0)
    net = IcoSweepNet(2, 4, feature_channels=2, num_cameras=3)
    with torch.no_grad():
        for part in net.modules():
            if isinstance(part, torch.nn.modules.batchnorm._BatchNorm):
                part.momentum = 1.0
        net.train()(torch.randn(2, 3, 3, 162), RIG)
    return Predictor(RIG, net.eval(), min_depth=0.5)


def test_a_program_is_its_predictor() -> None:
    images = render_rig(make_scene("room", seed=1), RIG)
    one = predictor()
    depth = one(images)
    stacked = torch.stack(list(images.values()))[None]
    with torch.inference_mode():
        inverse_depth, confidence, seen = RigProgram(one)(stacked)
        torch.testing.assert_close(inverse_depth[0], depth.inverse_depth, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(confidence[0], depth.confidence, rtol=1e-4, atol=1e-5)
        assert torch.equal(seen[0], depth.seen)
        on_sphere, _ = one.inputs(images)
        torch.testing.assert_close(RigProgram(one, "sphere")(on_sphere[None])[0], inverse_depth)
        panorama = depth.panorama(8)
        wide = RigProgram(one, height=8)(stacked)
        torch.testing.assert_close(wide[0][0].reciprocal(), panorama.depth, rtol=1e-4, atol=1e-4)
        assert torch.equal(wide[2][0], panorama.seen)


@pytest.mark.slow
def test_pt2_and_onnx_compute_the_same(tmp_path: Path) -> None:
    program = RigProgram(predictor(), "camera", height=6)
    exported = export_program(program, tmp_path / "depth.pt2")
    images = example_images(program)
    loaded = torch.export.load(tmp_path / "depth.pt2").module()
    for ours, theirs in zip(program(images), loaded(images), strict=True):
        torch.testing.assert_close(theirs, ours, rtol=1e-4, atol=1e-4)
    for package in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(package, reason="pip install sphericalvision[onnx]")
    path = export_onnx(exported, tmp_path / "depth.onnx")
    assert onnx_difference(path, program, images) < 1e-4


def test_what_does_not_depend_on_images_is_constant() -> None:
    class Indexing(torch.nn.Module):
        def forward(self, values: torch.Tensor) -> torch.Tensor:
            order = torch.arange(4).flip(0) * 2 % 4
            return values[..., order] + torch.ones(4).cumsum(0)

    values = torch.rand(2, 4)
    traced = torch.export.export(Indexing(), (values,)).module()
    calls = sum(node.op == "call_function" for node in traced.graph.nodes)
    folded = with_constants_folded(traced, values)  # type: ignore[arg-type]
    assert sum(node.op == "call_function" for node in folded.graph.nodes) <= 3 < calls
    other = torch.rand(2, 4)
    torch.testing.assert_close(folded(other), Indexing()(other))


def test_what_cannot_be_exported_is_told() -> None:
    lenses = [FisheyeCamera.from_field_of_view(size, 3.0) for size in ((16, 16), (16, 16), (16, 20))]
    uneven = CameraRig(lenses, RIG.world_from_camera)
    with pytest.raises(ArgumentError, match="one size"):
        RigProgram(Predictor(uneven, method="semi_global", level=3, min_depth=0.5))
    with pytest.raises(ArgumentError, match="first images"):
        RigProgram(Predictor(RIG, method="semi_global", level=3))
    with pytest.raises(ArgumentError, match="inputs"):
        RigProgram(predictor(), "panorama")
