# SPDX-License-Identifier: Apache-2.0
"""The crown and its layers against numbers of the original authors' implementation."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from sphericalvision.crown import Crown, CrownBatchNorm3d, crown_conv2d, crown_conv3d, from_crown, to_crown
from sphericalvision.icosphere import Icosphere

TOLERANCE = {"rtol": 0, "atol": 1e-5}


@pytest.fixture(scope="module")
def layers(golden: Path) -> dict[str, Tensor]:
    return torch.load(golden / "layers.pt", weights_only=True)


def crown_of(layers: dict[str, Tensor], prefix: str, col: str = "col", row: str = "row") -> Crown:
    """Read a crown whose batch is chart-major, (5 * B, ...)."""
    return Crown(
        *(layers[f"{prefix}{name}"].unflatten(0, (5, -1)).transpose(0, 1).contiguous() for name in (col, row))
    )


@pytest.mark.parametrize("level", [1, 3])
def test_to_crown_and_from_crown(layers: dict[str, Tensor], level: int) -> None:
    order = Icosphere(level).subdivision_order
    crown = to_crown(layers[f"l{level}.vertex"][..., order])
    expected = crown_of(layers, f"l{level}.unfold_")
    assert torch.equal(crown.col, expected.col)
    assert torch.equal(crown.row, expected.row)

    mean = from_crown(crown_of(layers, f"l{level}.in_"))
    torch.testing.assert_close(mean, layers[f"l{level}.integrated"][..., order], **TOLERANCE)


@pytest.mark.parametrize("level", [1, 3])
@pytest.mark.parametrize("stride", [1, 2])
def test_crown_conv2d(layers: dict[str, Tensor], level: int, stride: int) -> None:
    prefix = f"l{level}.conv2d_s{stride}."
    result = crown_conv2d(crown_of(layers, f"l{level}.in_"), layers[f"{prefix}weight"], stride=stride)
    expected = crown_of(layers, prefix)
    torch.testing.assert_close(result.col, expected.col, **TOLERANCE)
    torch.testing.assert_close(result.row, expected.row, **TOLERANCE)


def test_crown_conv3d_and_batch_norm(layers: dict[str, Tensor]) -> None:
    result = crown_conv3d(crown_of(layers, "l1.conv3d.in_"), layers["l1.conv3d.weight"])
    expected = crown_of(layers, "l1.conv3d.")
    torch.testing.assert_close(result.col, expected.col, **TOLERANCE)
    torch.testing.assert_close(result.row, expected.row, **TOLERANCE)

    norm = CrownBatchNorm3d(5)
    norm.load_state_dict(
        {key: layers[f"l1.bn3d.{key}"] for key in ("weight", "bias")}
        | {key: norm.state_dict()[key] for key in ("running_mean", "running_var", "num_batches_tracked")}
    )
    result, expected = norm(expected), crown_of(layers, "l1.bn3d.")
    torch.testing.assert_close(result.col, expected.col, **TOLERANCE)
    torch.testing.assert_close(result.row, expected.row, **TOLERANCE)
    torch.testing.assert_close(norm.running_mean, layers["l1.bn3d.running_mean"], **TOLERANCE)
    torch.testing.assert_close(norm.running_var, layers["l1.bn3d.running_var"], **TOLERANCE)
