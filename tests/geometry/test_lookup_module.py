# SPDX-License-Identifier: Apache-2.0
"""Modules of images become ONNX files, tables included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from sphericalvision.cameras import EquirectangularCamera, FisheyeCamera, Remap
from sphericalvision.sphere import Cubemap, Equirectangular, Resample

SOURCE = (24, 32)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Remap(FisheyeCamera.from_field_of_view(SOURCE, 3.0), EquirectangularCamera((20, 40))),
        lambda: Resample(Equirectangular(*SOURCE), Cubemap(6)),
    ],
)
def test_modules_become_onnx_files(make: object, tmp_path: Path) -> None:
    for package in ("onnx", "onnxscript"):
        pytest.importorskip(package)
    runtime = pytest.importorskip("onnxruntime")
    module = make().eval()  # type: ignore[operator]
    images = torch.rand(4, 3, *SOURCE)
    torch.onnx.export(module, (images,), tmp_path / "a.onnx", input_names=["input"], verbose=False)
    session = runtime.InferenceSession(tmp_path / "a.onnx", providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {"input": images.numpy()})
    np.testing.assert_allclose(found, module(images), atol=1e-6)
