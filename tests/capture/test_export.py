# SPDX-License-Identifier: Apache-2.0
"""Exported programs compute what the predictor computes, on images that they were not exported with."""

from __future__ import annotations

import json
import shutil
from functools import cache
from pathlib import Path

import pytest
import torch
from torch._inductor.exc import TritonMissing

from sphericalvision import Predictor
from sphericalvision.cameras import CameraRig, FisheyeCamera, ring_rig
from sphericalvision.capture.constant_folding import with_constants_folded
from sphericalvision.capture.export import (
    OUTPUTS,
    RigProgram,
    compile_program,
    example_images,
    export_onnx,
    export_program,
    onnx_difference,
    rig_tables,
)
from sphericalvision.capture.preparation.preparation import AS_IT_IS
from sphericalvision.core import ArgumentError, MissingCompilerError
from sphericalvision.icosphere import Icosphere
from sphericalvision.kernels import kernels
from sphericalvision.models import DepthNetwork, IcoSweepNet, OmniMVS, RefinedSweepNet
from sphericalvision.models.weights.files import STEP, with_bits
from sphericalvision.scenes import make_scene, render_rig
from sphericalvision.sphere import Equirectangular
from sphericalvision.sweep import DepthEstimate

RIG = ring_rig(3, image_size=(24, 30))

TENSORRT = """
Abs Acos Acosh Add And ArgMax ArgMin Asin Asinh Atan Atanh Attention AveragePool BatchNormalization
BlackmanWindow Cast CastLike Ceil Celu Clip Concat Constant ConstantOfShape Conv ConvTranspose Cos Cosh CumSum
DeformConv DepthToSpace DequantizeLinear Div Dropout Einsum Elu Equal Erf Exp Expand EyeLike Flatten Floor GRU
Gather GatherElements GatherND Gelu Gemm GlobalAveragePool GlobalLpPool GlobalMaxPool Greater GreaterOrEqual
GridSample GroupNormalization HammingWindow HannWindow HardSigmoid HardSwish Hardmax Identity If
InstanceNormalization IsInf IsNaN LRN LSTM LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax Loop
LpNormalization LpPool MatMul Max MaxPool Mean MeanVarianceNormalization Min Mish Mod Mul Neg
NonMaxSuppression NonZero Not OneHot Or PRelu Pad Pow QuantizeLinear RMSNormalization RNN RandomNormal
RandomNormalLike RandomUniform RandomUniformLike Range Reciprocal ReduceL1 ReduceL2 ReduceLogSum
ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Resize
ReverseSequence RoiAlign RotaryEmbedding Round STFT Scan Scatter ScatterElements ScatterND Selu Shape Shrink
Sigmoid Sign Sin Sinh Size Slice Softmax Softplus Softsign SpaceToDepth Split Sqrt Squeeze Sub Sum Tan Tanh
TensorScatter ThresholdedRelu Tile TopK Transpose Trilu Unsqueeze Upsample Where Xor
"""
"""What the ONNX parser of TensorRT 10.15 takes, by its operators.md."""
FIXED_INPUTS = {"Squeeze": 1, "Unsqueeze": 1, "Slice": 3}
"""Operator -> its input that TensorRT wants as a constant; of reductions it is the first one after the values."""


def needs_onnx() -> None:
    for package in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(package, reason="pip install sphericalvision[onnx]")


def check_for_tensorrt(path: Path) -> None:
    """Every node is of a kind that TensorRT takes, within the restrictions of its list, and none waits for values."""
    import onnx

    graph = onnx.shape_inference.infer_shapes(onnx.load(path)).graph
    assert {node.op_type for node in graph.node} <= set(TENSORRT.split()) - {"NonZero"}
    assert len(graph.node) <= 4_000  # at level 7, with a panorama
    ranks = {info.name: len(info.type.tensor_type.shape.dim) for info in graph.value_info}
    constants = {tensor.name for tensor in graph.initializer}
    constants |= {name for node in graph.node if node.op_type == "Constant" for name in node.output}
    for node in graph.node:
        if node.op_type == "GridSample":
            assert ranks[node.output[0]] == 4
        if node.op_type == "ScatterND":
            assert not any(attribute.name == "reduction" for attribute in node.attribute)
        fixed = 1 if node.op_type.startswith("Reduce") else FIXED_INPUTS.get(node.op_type, len(node.input))
        assert set(node.input[fixed : fixed + 1]) <= constants | {""}, node.op_type


def predictor() -> Predictor:
    torch.manual_seed(0)
    net = IcoSweepNet(2, 4, feature_channels=2, num_cameras=3)
    with torch.no_grad():
        for part in net.modules():
            if isinstance(part, torch.nn.modules.batchnorm._BatchNorm):
                part.momentum = 1.0
        net.train()(torch.randn(2, 3, 3, 162), RIG)
    return Predictor(RIG, net.eval(), min_depth=0.5, preparation=AS_IT_IS)


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


def test_beyond_the_band_of_a_network_a_panorama_has_no_depth() -> None:
    """OmniMVS has no poles: what is above and below is NaN, and not seen, whatever the nearest row says."""
    net = OmniMVS(8, feature_channels=2, num_cameras=3, output_size=(32, 128), in_channels=3, num_scales=2)
    one = Predictor(RIG, net.eval(), min_depth=0.5, preparation=AS_IT_IS)
    stacked = torch.stack(list(render_rig(make_scene("room", seed=1), RIG).values()))[None]
    with torch.inference_mode():
        inverse_depth, _, seen = RigProgram(one, height=16)(stacked)
    rays = Equirectangular(16, 32).directions.reshape(-1, 3)
    reached = net.index_at(torch.zeros(1, *net.grid.shape), rays)[1].view(1, 16, 32)
    assert not reached[:, [0, -1]].any()
    assert torch.equal(inverse_depth.isfinite(), reached)
    assert seen.any()
    assert not (seen & ~reached).any()


@cache
def refined(radius: float = 0.2, **options: object) -> RigProgram:
    """A small network as the default one is, with weights that change its answer."""
    torch.manual_seed(0)
    net = RefinedSweepNet(2, 8, inner_hypotheses=8, widths=(4, 6), blocks=1)
    with torch.no_grad():
        for weight in net.parameters():
            if not weight.any():
                weight.normal_(std=0.1)
    rig = ring_rig(3, radius=radius, image_size=(24, 30))
    return RigProgram(Predictor(rig, net.eval(), min_depth=0.5), **options).eval()  # type: ignore[arg-type]


def test_few_large_operators_are_the_same_for_a_whole_network() -> None:
    program = refined(height=8)
    images = example_images(program, batch=2)
    with torch.inference_mode():
        expected = program(images)
        with kernels("graph"):
            found = program(images)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


def test_tables_of_another_rig() -> None:
    one, other = refined(tables="inputs"), refined(radius=0.1)
    images = example_images(one)
    with torch.inference_mode():
        torch.testing.assert_close(one(images, rig_tables(other, like=one)), other(images))
        assert not torch.allclose(one(images, rig_tables(one))[0], other(images)[0])
    with pytest.raises(ArgumentError, match="as many cameras"):
        rig_tables(RigProgram(predictor()), like=one)


@pytest.mark.slow
@pytest.mark.parametrize("tables", ["inside", "inputs"])
def test_the_default_network_as_a_program(tables: str, tmp_path: Path) -> None:
    needs_onnx()
    program, batch = refined(height=8, tables=tables), 1 if tables == "inside" else None
    exported = export_program(program, tmp_path / "depth.pt2", batch)
    assert sum(node.op == "call_function" for node in exported.graph.nodes) < 3000
    loaded = torch.export.load(tmp_path / "depth.pt2").module()
    path = export_onnx(exported, tmp_path / "depth.onnx")
    check_for_tensorrt(path)
    for size in (1,) if batch else (1, 3):
        images = example_images(program, size)
        inputs = (images,) if batch else (images, rig_tables(program))
        torch.testing.assert_close(loaded(*inputs), program(*inputs), rtol=1e-4, atol=1e-4)
        assert onnx_difference(path, program, images) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("weights", "level", "side", "height", "limit"),
    # Candidates of the default network are the best of few, so in some places it makes much of rounding: noise of 1e-6
    # in the images changes them by 2e-4, too.
    [(None, None, 200, 160, 1e-3), ("icosweepnet-small", 4, 40, 16, 1e-4)],
)
def test_networks_that_ship_for_tensorrt(
    weights: str | None, level: int | None, side: int, height: int, limit: float, tmp_path: Path
) -> None:
    needs_onnx()
    rig = ring_rig(4, image_size=(side, side))
    program = RigProgram(Predictor(rig, weights, level=level, min_depth=0.55), height=height)
    images = torch.stack(list(render_rig(make_scene("room", seed=1), rig).values()))[None]
    path = export_onnx(export_program(program), tmp_path / "depth.onnx")
    check_for_tensorrt(path)
    assert onnx_difference(path, program, images) < limit


class Bright(DepthNetwork):
    """What is bright is near: a network that is exported in a second."""

    def __init__(self, level: int = 1, num_hypotheses: int = 4, min_depth: float = 0.5) -> None:
        super().__init__(num_hypotheses, min_depth, num_cameras=2)
        self.level, self.grid = level, Icosphere(level)
        self.scale = torch.nn.Parameter(torch.tensor(1.4))

    def predict(self, images: torch.Tensor, rig: object, seen: torch.Tensor | None = None) -> DepthEstimate:  # type: ignore[override]
        assert seen is not None
        index = (images.mean((1, 2)) + 1) * self.scale
        return DepthEstimate(index, images[:, 0, 0].sigmoid(), seen.all(-2).expand_as(index))


def exported_alike(program: RigProgram, folder: Path, tolerance: float) -> Path:
    """The ONNX file of a program; it and the exported graph compute what the program does."""
    exported = export_program(program, folder / "depth.pt2")
    assert exported.example_inputs[0][0].untyped_storage().nbytes() == 4  # the file holds no images
    images = example_images(program)
    loaded = torch.export.load(folder / "depth.pt2").module()
    torch.testing.assert_close(loaded(images), program(images), rtol=tolerance, atol=tolerance)
    needs_onnx()
    path = export_onnx(exported, folder / "depth.onnx")
    assert onnx_difference(path, program, images) < tolerance
    return path


def test_a_small_network_as_pt2_and_onnx(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    program = RigProgram(Predictor(ring_rig(2, image_size=(8, 8)), Bright(), min_depth=0.5))
    path = exported_alike(program, tmp_path, 1e-5)
    import onnx

    told = json.loads((tmp_path / "depth.json").read_text())
    assert {entry.key: entry.value for entry in onnx.load(path).metadata_props}.items() >= told.items()
    assert told["cameras"] == "cam1, cam2"
    assert "[0, 1]" in told["images"]
    assert (told["min_depth"], told["num_hypotheses"]) == ("0.5", "4")
    check_onnx_is_clean(path)
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""


def check_onnx_is_clean(path: Path) -> None:
    """Nothing is stored that is not used; GridSample's mode is the name that TensorRT 10 knows, before opset 20."""
    import onnx
    import onnxruntime

    graph = onnx.load(path).graph
    used = {name for node in graph.node for name in node.input} | set(OUTPUTS)
    assert {tensor.name for tensor in graph.initializer} <= used
    assert all(used & set(node.output) for node in graph.node)
    samplers = [node for node in graph.node if node.op_type == "GridSample"]
    assert samplers
    for node in samplers:
        assert b"bilinear" in {attribute.s for attribute in node.attribute}
    onnxruntime.InferenceSession(path)  # prints a line for each tensor that is not used


@pytest.mark.slow
def test_pt2_and_onnx_compute_the_same(tmp_path: Path) -> None:
    exported_alike(RigProgram(predictor(), "camera", height=6), tmp_path, 1e-4)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")
def test_a_compiled_program_computes_the_same(tmp_path: Path) -> None:
    program = RigProgram(predictor(), "camera", height=6)
    package = compile_program(export_program(program), tmp_path / "depth.pt2")
    images = example_images(program)
    with torch.inference_mode():
        compiled = torch._inductor.aoti_load_package(str(package))(images)
        torch.testing.assert_close(compiled, program(images), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_program_computes_in_the_precision_of_its_predictor(tmp_path: Path) -> None:
    net = predictor().network
    options = {"min_depth": 0.5, "preparation": AS_IT_IS}
    exact, reduced = (
        RigProgram(Predictor(RIG, net, precision=precision, **options), "sphere")  # type: ignore[arg-type]
        for precision in ("float32", "bfloat16")
    )
    exported = export_program(reduced, tmp_path / "depth.pt2")
    convolutions = [node for node in exported.graph.nodes if str(node.target).startswith("aten.conv")]
    assert len(convolutions) == 62
    for node in convolutions:
        assert {argument.meta["val"].dtype for argument in node.args[:2]} == {torch.bfloat16}
    images = example_images(reduced)
    with torch.inference_mode():
        loaded = torch.export.load(tmp_path / "depth.pt2").module()(images)
        torch.testing.assert_close(loaded, reduced(images), rtol=2e-2, atol=2e-2)
        difference = (loaded[0] - exact(images)[0]).abs().mean()
    assert 0 < difference < 0.02
    told = json.loads((tmp_path / "depth.json").read_text())
    assert (told["device"], told["precision"][:8]) == ("cpu", "bfloat16")


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (TritonMissing(None), "compiled: for device=cuda needs Triton"),
        (OSError("CUDA_HOME environment variable is not set."), "CUDA_HOME names its folder"),
    ],
)
def test_what_compiling_for_cuda_needs_is_told(
    error: Exception, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiling for CUDA needs a device: what it raises without Triton or the toolkit is raised here."""

    def refuse(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("torch._inductor.aoti_compile_and_package", refuse)
    program = RigProgram(Predictor(ring_rig(2, image_size=(8, 8)), Bright(), min_depth=0.5))
    with pytest.raises(MissingCompilerError, match=told):
        compile_program(export_program(program), tmp_path / "depth.pt2")
    assert not list(tmp_path.iterdir())


def test_what_does_not_depend_on_images_is_constant() -> None:
    class Indexing(torch.nn.Module):
        def forward(self, values: torch.Tensor) -> torch.Tensor:
            order = torch.arange(4).flip(0) * 2 % 4
            there = values.index_select(-1, torch.arange(4).flip(0))
            return values[..., order] + there + torch.ones(4).cumsum(0)

    values = torch.rand(2, 4)
    traced = torch.export.export(Indexing(), (values,)).module()
    calls = sum(node.op == "call_function" for node in traced.graph.nodes)
    folded = with_constants_folded(traced, values)  # type: ignore[arg-type]
    assert sum(node.op == "call_function" for node in folded.graph.nodes) <= 4 < calls
    kinds = {constant.dtype for constant in folded.buffers() if not constant.is_floating_point()}
    assert kinds == {torch.int32, torch.int64}  # what is selected by number needs 32 bits, an index 64
    other = torch.rand(2, 4)
    torch.testing.assert_close(folded(other), Indexing()(other))


@pytest.mark.parametrize(("highest", "stored_numbers"), [(50, 60_000), (2, 20_000)])
def test_views_of_a_large_table_share_it(highest: int, stored_numbers: int) -> None:
    """A table that is read as a whole and by its columns is stored once, in 32 bits, and so are rows that repeat."""

    class Reading(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("table", torch.randint(highest, (20_000, 3)))

        def forward(self, values: torch.Tensor) -> torch.Tensor:
            rows = self.table + torch.arange(3)
            columns = sum(values.index_select(0, rows[:, k]) for k in range(3))
            return columns + values[self.table.view(-1)[:20_000]]

    reading, values = Reading(), torch.rand(60)
    folded = with_constants_folded(torch.export.export(reading, (values,)).module(), values)  # type: ignore[arg-type]
    program = torch.export.export(folded, (values,))
    stored = [*program.constants.values(), *program.state_dict.values()]
    assert sum(tensor.nbytes for tensor in stored) < 1.01 * stored_numbers * 4
    other = torch.rand(60)
    torch.testing.assert_close(program.module()(other), reading(other))


def test_rows_of_zeros_are_not_stored() -> None:
    """As the weights of a sweep, which are zero out of view."""
    weights = torch.rand(30_000, 3) * (torch.arange(30_000) % 2)[:, None]

    class Weighting(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("weights", weights)

        def forward(self, values: torch.Tensor) -> torch.Tensor:
            return (self.weights * values).sum(1)

    values = torch.rand(3)
    program = torch.export.export(Weighting(), (values,)).module()
    folded = with_constants_folded(program, values)  # type: ignore[arg-type]
    stored = [*folded.parameters(), *folded.buffers()]
    assert sum(tensor.nbytes for tensor in stored) < 0.6 * weights.nbytes
    torch.testing.assert_close(folded(-values), weights @ -values)


def test_weights_of_eight_bits_are_stored_as_halves_and_tables_once() -> None:
    convolution = torch.nn.Conv1d(64, 128, 3, bias=False)
    kept = dict(with_bits("weight", convolution.weight.detach(), 8))
    convolution.weight.data = kept["weight"] * kept["weight" + STEP]
    table = torch.rand(1, 128, 300)

    class Twice(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.convolution = convolution
            self.register_buffer("table", table, persistent=False)

        def forward(self, values: torch.Tensor) -> torch.Tensor:
            return self.convolution(values) * (self.table * 2) + (self.table + self.table)

    values = torch.rand(1, 64, 302)
    program = torch.export.export(Twice(), (values,)).module()
    folded = with_constants_folded(program, values)  # type: ignore[arg-type]
    stored = [*folded.parameters(), *folded.buffers()]
    assert sum(tensor.nbytes for tensor in stored) < 0.52 * convolution.weight.nbytes + 1.01 * table.nbytes
    torch.testing.assert_close(folded(-values), Twice()(-values))


def test_what_cannot_be_exported_is_told() -> None:
    lenses = [FisheyeCamera.from_field_of_view(size, 3.0) for size in ((16, 16), (16, 16), (16, 20))]
    uneven = CameraRig(lenses, RIG.world_from_camera)
    with pytest.raises(ArgumentError, match="one size"):
        RigProgram(Predictor(uneven, method="semi_global", level=3, min_depth=0.5))
    with pytest.raises(ArgumentError, match="first images"):
        RigProgram(Predictor(RIG, method="semi_global", level=3))
    with pytest.raises(ArgumentError, match="inputs"):
        RigProgram(predictor(), "panorama")
