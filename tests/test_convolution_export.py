# SPDX-License-Identifier: Apache-2.0
"""Every convolution, padding, crown layer and kept table under torch.compile, torch.export and in ONNX."""

import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from sphericalvision.cameras import EquirectangularCamera, FisheyeCamera, Remap
from sphericalvision.crown import (
    CrownAvgPool2d,
    CrownBatchNorm2d,
    CrownBatchNorm3d,
    CrownConv2d,
    CrownConv3d,
    CrownExchange,
    CrownInstanceNorm2d,
    CrownInstanceNorm3d,
    CrownMaxPool2d,
    CrownPointwise,
    CrownUpsample,
    FromCrown,
    HexConv2d,
    HexConv3d,
    ToCrown,
)
from sphericalvision.icosphere import Icosphere, IcospherePool, IcosphereUpsample
from sphericalvision.sphere import (
    Cubemap,
    CubePad2d,
    Equirectangular,
    EquirectangularPad2d,
    Healpix,
    Resample,
    SphereConv2d,
    TangentImages,
    make_seamless,
)


def crown_network() -> nn.Module:
    return nn.Sequential(
        ToCrown(),
        CrownConv2d(3, 4, bias=True),
        CrownBatchNorm2d(4),
        CrownPointwise(nn.GELU()),
        CrownExchange(),
        CrownMaxPool2d(),
        CrownConv2d(4, 4),
        CrownUpsample(),
        CrownAvgPool2d(),
        FromCrown(),
    )


def crown_network_3d() -> nn.Module:
    return nn.Sequential(
        ToCrown(), CrownConv3d(2, 3, bias=True), CrownBatchNorm3d(3), CrownConv3d(3, 2, stride=2), FromCrown()
    )


def crown_instance_norms() -> nn.Module:
    norms = CrownInstanceNorm2d(3), CrownInstanceNorm3d(2)
    return nn.Sequential(ToCrown(), norms[0], FromCrown(), nn.Unflatten(1, (1, 3)), Volumes(norms[1]))


class Volumes(nn.Module):
    """Three channels as the hypotheses of two."""

    def __init__(self, norm: nn.Module) -> None:
        super().__init__()
        self.layers = nn.Sequential(ToCrown(), norm, FromCrown())

    def forward(self, values: Tensor) -> Tensor:
        return self.layers(torch.cat((values, values.square()), 1))


FISHEYE = FisheyeCamera.from_field_of_view((8, 8), 3.3)
TURN = torch.tensor([[0.0, 0.6, 0.8], [0.0, 0.8, -0.6], [-1.0, 0.0, 0.0]])

NETWORKS: dict[str, tuple[Callable[[], nn.Module], tuple[int, ...]]] = {
    "crown": (crown_network, (2, 3, 162)),
    "crown_3d": (crown_network_3d, (1, 2, 4, 42)),
    "hex": (lambda: nn.Sequential(HexConv2d(3, 4, bias=True), nn.ReLU(), HexConv2d(4, 2, 2)), (2, 3, 162)),
    "hex_north": (lambda: HexConv2d(3, 4, stride=2, orientation="north", level=2), (2, 3, 162)),
    "hex_3d": (lambda: HexConv3d(2, 3, bias=True), (1, 2, 4, 42)),
    "sphere": (lambda: nn.Sequential(SphereConv2d(2, 3, stride=2), SphereConv2d(3, 2)), (2, 2, 12, 24)),
    "panorama": (
        lambda: nn.Sequential(EquirectangularPad2d((1, 2, 3, 1)), nn.Conv2d(2, 3, 3)),
        (2, 2, 6, 12),
    ),
    "cube": (lambda: nn.Sequential(CubePad2d(1), nn.Conv2d(2, 3, 3)), (6, 2, 4, 4)),
    "circular": (
        lambda: make_seamless(nn.Sequential(nn.Conv2d(2, 3, 3, padding=1), nn.ReLU())),
        (1, 2, 6, 12),
    ),
    "instance_norms": (crown_instance_norms, (2, 3, 42)),
    "pool_upsample": (
        lambda: nn.Sequential(IcospherePool(2, "max"), IcosphereUpsample(1), IcospherePool(2)),
        (2, 3, 162),
    ),
    "panorama_to_cube": (lambda: Resample(Equirectangular(6, 12), Cubemap(4), TURN), (2, 3, 6, 12)),
    "cube_to_panorama": (lambda: Resample(Cubemap(4), Equirectangular(6, 12), TURN), (2, 3, 6, 4, 4)),
    "icosphere_to_healpix": (lambda: Resample(Icosphere(2), Healpix(2), mode="area"), (2, 3, 162)),
    "healpix_to_tangent": (lambda: Resample(Healpix(4), TangentImages(0, 3), TURN), (2, 3, 192)),
    "tangent_to_icosphere": (lambda: Resample(TangentImages(0, 4), Icosphere(1), TURN), (2, 3, 20, 4, 4)),
    "fisheye_to_panorama": (
        lambda: Resample(FISHEYE, Equirectangular(6, 12), mode="area", fill=-1),
        (2, 3, 8, 8),
    ),
    "panorama_to_fisheye": (lambda: Resample(Equirectangular(6, 12), FISHEYE, fill=-1), (2, 3, 6, 12)),
    "remap": (lambda: Remap(FISHEYE, EquirectangularCamera((6, 12))), (2, 3, 8, 8)),
    "nearest": (lambda: Resample(Cubemap(4), Icosphere(2), mode="nearest"), (2, 3, 6, 4, 4)),
}


def make(name: str) -> tuple[nn.Module, Tensor]:
    torch.manual_seed(0)
    network, shape = NETWORKS[name]
    torch._dynamo.reset()
    return network().eval(), torch.randn(shape)


def check_compiled(name: str, backend: str) -> None:
    network, values = make(name)
    values.requires_grad_()
    compiled = torch.compile(network, fullgraph=True, backend=backend)
    inputs = (values, *network.parameters())
    expected, result = network(values), compiled(values)
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5)
    weights = torch.randn_like(expected)
    for ours, theirs in zip(
        torch.autograd.grad(result, inputs, weights),
        torch.autograd.grad(expected, inputs, weights),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-4)


# Of networks that differ only in what is in their tables, one is compiled and exported each time.
ALIKE = (
    "hex_north",
    "circular",
    "cube_to_panorama",
    "healpix_to_tangent",
    "tangent_to_icosphere",
    "panorama_to_fisheye",
)
COMPILED = [pytest.param(name, marks=pytest.mark.slow) if name in ALIKE else name for name in NETWORKS]


@pytest.mark.parametrize("name", COMPILED)
def test_compiles_as_one_graph(name: str) -> None:
    check_compiled(name, "eager")


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_compiles_with_inductor(name: str) -> None:
    check_compiled(name, "inductor")


@pytest.mark.parametrize("name", COMPILED)
def test_exports(name: str) -> None:
    network, values = make(name)
    program = torch.export.export(network, (values,))
    other = torch.randn_like(values)
    torch.testing.assert_close(program.module()(other), network(other))


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_runs_as_onnx(name: str, tmp_path: Path) -> None:
    reason = "needs onnx, onnxscript and onnxruntime: pip install sphericalvision[onnx]"
    for package in ("onnx", "onnxscript"):
        pytest.importorskip(package, reason=reason)
    onnxruntime = pytest.importorskip("onnxruntime", reason=reason)
    network, values = make(name)
    path = tmp_path / "network.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(network, (values,), path, dynamo=True, verbose=False)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    other = torch.randn_like(values)
    (result,) = session.run(None, {session.get_inputs()[0].name: other.numpy()})
    torch.testing.assert_close(torch.from_numpy(result), network(other).detach(), rtol=1e-4, atol=1e-4)
