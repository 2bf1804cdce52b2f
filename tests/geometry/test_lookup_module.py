# SPDX-License-Identifier: Apache-2.0
"""Modules of images take and give what Kornia's do, and become ONNX files."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from kornia.core.module import ImageModule

from sphericalvision.cameras import EquirectangularCamera, FisheyeCamera, Remap
from sphericalvision.core import ArgumentError
from sphericalvision.geometry.masked_lookup import LookupModule
from sphericalvision.io.images import read_image
from sphericalvision.sphere import Cubemap, Equirectangular, Resample

SOURCE = (24, 32)


def remap() -> Remap:
    return Remap(FisheyeCamera.from_field_of_view(SOURCE, 3.0), EquirectangularCamera((20, 40)))


class OfKornia(ImageModule):
    def __init__(self, inner: LookupModule) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = self.inner(image)
        return found


@pytest.mark.parametrize("output_type", ["pt", "numpy", "pil"])
def test_inputs_and_outputs_are_those_of_kornia(output_type: Literal["pt", "numpy", "pil"]) -> None:
    pil = pytest.importorskip("PIL.Image")
    array = np.random.default_rng(0).integers(0, 256, (*SOURCE, 3), np.uint8)
    ours = remap()
    theirs = OfKornia(ours)
    for image in (
        array,
        array / 255.0,
        pil.fromarray(array),
        torch.rand(3, *SOURCE),
        torch.rand(2, 3, *SOURCE),
    ):
        found, expected = (module(image, output_type=output_type) for module in (ours, theirs))
        assert type(found) is type(expected)
        found, expected = (
            [one] if output_type == "pil" and not isinstance(one, list) else one for one in (found, expected)
        )
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(np.asarray(one), np.asarray(other))
        np.testing.assert_array_equal(
            np.asarray(ours.show(display=False)), np.asarray(theirs.show(display=False))
        )
    with pytest.raises(ArgumentError, match="output_type"):
        ours(array, output_type="jax")


def test_the_last_result_is_saved_and_not_carried_along(tmp_path: Path) -> None:
    module = remap()
    with pytest.raises(ValueError, match="execute first"):
        module.show()
    result = module(torch.rand(3, *SOURCE))
    module.save(str(tmp_path / "a.png"))
    torch.testing.assert_close(read_image(tmp_path / "a.png"), result, atol=0.003, rtol=0)
    for again in (copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        with pytest.raises(ValueError, match="execute first"):
            again.show()
    module.disable_features = True
    module(torch.zeros(3, *SOURCE))
    assert np.asarray(module.show(display=False)).any(), "the result before it was switched off"


@pytest.mark.parametrize("make", [remap, lambda: Resample(Equirectangular(*SOURCE), Cubemap(6))])
def test_modules_become_onnx_files(make: object, tmp_path: Path) -> None:
    for package in ("onnx", "onnxscript"):
        pytest.importorskip(package)
    runtime = pytest.importorskip("onnxruntime")
    module = make()  # type: ignore[operator]
    module.to_onnx(tmp_path / "a.onnx")
    images = torch.rand(4, 3, *SOURCE)
    session = runtime.InferenceSession(tmp_path / "a.onnx", providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {"input": images.numpy()})
    np.testing.assert_allclose(found, module(images), atol=1e-6)
