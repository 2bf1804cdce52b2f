# SPDX-License-Identifier: Apache-2.0
"""A frame as a device computes it: nothing goes to the host or comes from it, and graphs are replayed for each call."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch
from torch import Tensor

from sphericalvision.cameras import ring_rig
from sphericalvision.capture import Predictor, graphs
from sphericalvision.capture.graphs import GraphedFunction, NoWaiting
from sphericalvision.capture.pipeline import Pipeline
from sphericalvision.capture.preparation import preparation
from sphericalvision.capture.preparation.photometry import eliminated
from sphericalvision.capture.preparation.preparation import Preparation, bilateral
from sphericalvision.core import ArgumentError
from sphericalvision.kernels import kernels
from sphericalvision.models import IcoSweepNet, OmniMVS, WinnerTakesAll, pretrained
from sphericalvision.scenes import make_scene, render_rig
from sphericalvision.scenes.disturbances import vignetted
from sphericalvision.sweep import DepthEstimate

RIG = ring_rig(4, image_size=(48, 56))
Images = dict[str, Tensor]


class Flat(WinnerTakesAll):
    """A network that does next to nothing."""

    def predict(self, images: Tensor, rig: object, seen: Tensor | None = None) -> DepthEstimate:
        index = images.mean((1, 2))[:, : self.grid.num_vertices].abs()
        return DepthEstimate(index, index, index > 0)


class Shown(Flat):
    """Its confidence is the number of cameras that show something."""

    def predict(self, images: Tensor, rig: object, seen: Tensor | None = None) -> DepthEstimate:
        assert seen is not None
        count = seen.expand(images[:, :, 0].shape).sum(1).float()
        return DepthEstimate(count, count, count > 1)


def room(factor: float = 1.0, loss: float = 0.0, noise: float = 0.0) -> Images:
    """Bytes of four cameras, as programs hold them, darker, vignetted and noisy."""
    generator = torch.Generator().manual_seed(0)
    images = {}
    for name, image in render_rig(make_scene("room", seed=1), RIG).items():
        image = vignetted(image, RIG.cameras[name], loss) if loss else image
        image = image * factor + noise * torch.randn(image.shape, generator=generator)
        images[name] = (255 * image).round().clamp(0, 255).byte()
    return images


class NoHost(NoWaiting):
    """Refuses tensors of Python's numbers as well: on a device each is a copy from the host."""

    WAITS = (*NoWaiting.WAITS, "lift_fresh")


@pytest.mark.parametrize(
    "images",
    [room(), room(loss=0.6), room(noise=0.05), room(0.1), room(0.0)],
    ids=["good", "vignetted", "noisy", "dark", "black"],
)
@pytest.mark.parametrize("takes", ["sphere", "camera"])
def test_a_device_is_told_everything_at_once_and_finds_what_a_cpu_finds(images: Images, takes: str) -> None:
    class Takes(Flat):
        pass

    Takes.images = takes  # type: ignore[assignment]
    made = Pipeline(Takes(3, 8), RIG)
    batch = {name: torch.stack((image, image.flip(-1))) for name, image in images.items()}
    for given in (images, batch):
        colors = {name: image.float() / 255 for name, image in given.items()}
        inputs, corrections = made.inputs(colors, Preparation())
        expected = [correction.compensation(RIG) for correction in corrections]
        with kernels("graph"):
            made.inputs(colors, Preparation())  # makes what is made once
            with torch.inference_mode(), NoHost():
                result, corrections = made.inputs(colors, Preparation())
        # OpenCV interpolates the exponential of its weights in a table.
        torch.testing.assert_close(result, inputs, atol=5e-3, rtol=0)
        for one, other in zip(corrections, expected, strict=True):
            compensation = one.compensation(RIG)
            assert compensation.noise == pytest.approx(other.noise, abs=1e-6)
            assert compensation.gain == pytest.approx(other.gain)
            assert (compensation.light is None) == (other.light is None)


FLAT, RANDOM = torch.full((3, 48, 56), 0.5), torch.rand(3, 48, 56, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("image", "shows"),
    [
        (RANDOM, True),
        (torch.cat((FLAT[:2], RANDOM[2:])), True),  # a sky of one red and one green
        (FLAT + 0.003 * (RANDOM - 0.5), False),
        (torch.cat((FLAT[..., :28], RANDOM[..., 28:]), -1), False),  # masked
    ],
    ids=["texture", "one colour", "less than a step", "masked"],
)
def test_an_image_of_one_value_shows_nothing(image: Tensor, shows: bool) -> None:
    mask = (torch.arange(56) < 22).expand(48, 56)
    made = Pipeline(Shown(3, 8), RIG.replaced(masks={"cam1": mask}))
    colors = {name: values.float() / 255 for name, values in room().items()} | {"cam1": image}
    estimate, _ = made.estimate(made.intake(colors))
    expected = made.intake.seen[0 if shows else 1 :].sum(0).float()
    torch.testing.assert_close(estimate.confidence, expected)


@pytest.mark.parametrize("network", ["shipped", "paper"])
def test_a_whole_frame_is_computed_without_the_host(network: str) -> None:
    """From bytes to depth, by the networks themselves."""
    torch.manual_seed(0)
    paper = IcoSweepNet(4, 8, feature_channels=4).eval()
    net = pretrained().at_level(5) if network == "shipped" else paper
    predictor, images = Predictor(RIG, net, min_depth=0.55), room(loss=0.6)
    expected = predictor(images)
    options = {"preparation": Preparation()}
    with kernels("graph"), torch.inference_mode():
        predictor.pipeline.frame(*images.values(), **options)  # type: ignore[arg-type]
        with NoHost():
            frame = predictor.pipeline.frame(*images.values(), **options)  # type: ignore[arg-type]
    torch.testing.assert_close(frame.estimate.index, expected.index, atol=0.02, rtol=0)


def test_smoothing_is_opencvs() -> None:
    generator = torch.Generator().manual_seed(0)
    frames = torch.rand(2, 3, 40, 30, generator=generator) * 0.2 + 0.4
    deviation = torch.tensor([0.1, 0.25])
    for image in (frames, frames[:, :1]):
        expected = preparation._filtered_by_opencv(image, deviation)
        torch.testing.assert_close(bilateral(image, deviation), expected, atol=2e-3, rtol=0)
    assert bilateral(frames[..., :3, :], deviation).isfinite().all()  # smaller than the window


@pytest.mark.skipif(not torch.cuda.is_available(), reason="the kernel is for CUDA devices")
@pytest.mark.parametrize("channels", [1, 3])
def test_the_kernel_is_the_filter(channels: int) -> None:
    images = torch.rand(2, channels, 37, 53)
    deviation = torch.tensor([0.1, 0.0])
    torch.testing.assert_close(bilateral(images.cuda(), deviation.cuda()).cpu(), bilateral(images, deviation))


def test_elimination_solves() -> None:
    generator = torch.Generator().manual_seed(0)
    factor = torch.randn(3, 20, 20, dtype=torch.float64, generator=generator)
    matrix = factor @ factor.mT + 0.1 * torch.eye(20, dtype=torch.float64)
    right = torch.randn(3, 20, dtype=torch.float64, generator=generator)
    torch.testing.assert_close(eliminated(matrix, right), torch.linalg.solve(matrix, right))


class _Event:
    def record(self) -> None: ...


def recorded(function: Callable[..., Any], inputs: tuple[Tensor, ...], options: dict[str, Any]) -> Any:
    """In the place of a capture: what a graph does, in its own memory."""
    static = tuple(value.clone() for value in inputs)
    outputs = function(*static, **options)

    def replay() -> None:
        leaves = (graphs._pytree.tree_leaves(each) for each in (outputs, function(*static, **options)))
        for mine, new in zip(*leaves, strict=True):
            if mine is not None:
                mine.copy_(new)

    return graphs._Graph(static, replay, outputs, _Event())


@pytest.fixture
def on_a_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Graphs of functions on a CPU."""

    class Stream:
        def wait_event(self, event: object) -> None: ...

    monkeypatch.setattr(graphs, "captured", recorded)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda *_: Stream())
    monkeypatch.setattr(torch.cuda, "device", lambda *_: threading.RLock())


@pytest.mark.usefixtures("on_a_cpu")
def test_results_of_a_graph_are_ones_own_and_threads_get_theirs() -> None:
    calls: list[tuple[int, ...]] = []

    def function(values: Tensor, factor: float = 1.0) -> tuple[Tensor, tuple[Tensor, None]]:
        calls.append(tuple(values.shape))
        return values * factor, (values + 1, None)

    graphed = GraphedFunction("it", function)
    assert graphed(torch.zeros(3), factor=2.0)[0].tolist() == [0] * 3
    assert graphed._graphs == {}  # what is called once needs none
    first, (more, nothing) = graphed(torch.zeros(3), factor=2.0)
    second, _ = graphed(torch.ones(3), factor=2.0)
    assert nothing is None
    assert (first.tolist(), more.tolist(), second.tolist()) == ([0] * 3, [1] * 3, [2] * 3)
    assert graphed(torch.ones(3), factor=3.0)[0].tolist() == [3] * 3  # another graph
    with ThreadPoolExecutor(4) as pool:
        numbers = torch.arange(20.0)[:, None].expand(20, 3)
        results = list(pool.map(lambda values: graphed(values, factor=2.0), numbers))
    for number, (values, _) in enumerate(results):
        assert values.tolist() == [2 * number] * 3


@pytest.mark.usefixtures("on_a_cpu")
def test_other_shapes_are_other_graphs_of_which_there_are_few() -> None:
    graphed = GraphedFunction("it", lambda values: values * 2)
    for number in range(1, graphs.MOST_GRAPHS + 1):
        assert [len(graphed(torch.ones(number))) for _ in range(2)] == [number] * 2
    graphed(torch.ones(10))
    with pytest.warns(UserWarning, match="it is computed without a CUDA graph, because there are 4 graphs"):
        assert graphed(torch.ones(10)).tolist() == [2] * 10


def test_what_cannot_be_captured_is_computed_otherwise_and_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise RuntimeError("operation not permitted when stream is capturing\nmore of it")

    monkeypatch.setattr(graphs, "captured", refuse)
    graphed = GraphedFunction("it", lambda values: values, otherwise=lambda values: values + 1)
    with pytest.warns(
        UserWarning, match="because operation not permitted when stream is capturing$"
    ) as record:
        results = [graphed(torch.zeros(2)).tolist() for _ in range(3)]
    assert results == [[0, 0], [1, 1], [1, 1]]
    assert len(record) == 1


@pytest.mark.usefixtures("on_a_cpu")
def test_a_predictor_on_a_device_answers_by_its_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole frame, from bytes: with the graph of a CPU in the place of CUDA's."""
    images = room(loss=0.6)
    expected = Predictor(RIG, Flat(3, 8), min_depth=0.5)(images)
    predictor = Predictor(RIG, Flat(3, 8), min_depth=0.5)
    monkeypatch.setattr(predictor.pipeline, "on_cuda", True)
    dark = {name: image // 2 for name, image in images.items()}
    with kernels("graph"):
        predictor(dark)
        first, other, again = predictor(images), predictor(dark), predictor(images)
    assert len(predictor.pipeline._graphed._graphs) == 1
    torch.testing.assert_close(first.index, expected.index, atol=1e-5, rtol=0)
    assert torch.equal(first.index, again.index)
    assert not torch.equal(first.index, other.index)
    light, same = (depth.compensations[0].light for depth in (first, expected))
    assert light is not None
    assert same is not None
    torch.testing.assert_close(light.exposure, same.exposure)
    torch.testing.assert_close(light.falloff, same.falloff, atol=1e-4, rtol=1e-3)
    assert first.images["cam1"].equal(expected.images["cam1"])
    assert first.images["cam1"].equal(images["cam1"].float() / 255)


@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_less_precise_networks_differ_little(precision: str) -> None:
    images = room()
    net = OmniMVS(8, output_size=(8, 32), feature_channels=2, num_cameras=4, num_scales=2).eval()
    exact = Predictor(RIG, net, min_depth=0.5)
    less = Predictor(RIG, net, min_depth=0.5, precision=precision)  # type: ignore[arg-type]
    one, other = exact(images), less(images)
    assert other.index.dtype == torch.float32
    assert not torch.equal(one.index, other.index)
    assert (one.index - other.index).abs().mean() < 0.05


def test_too_little_memory_is_told_with_what_would_help(monkeypatch: pytest.MonkeyPatch) -> None:
    predictor = Predictor(RIG, Flat(3, 8), min_depth=0.5)

    def exhausted(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(Pipeline, "__call__", exhausted)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda *_: 3 * 2**30)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (2**30, 4 * 2**30))
    with pytest.raises(ArgumentError, match=r"more than 3.0 GiB of cpu.* 4.0 GiB, 1.0 GiB .* level=2 needs"):
        predictor(room())


def test_a_driver_that_is_too_old_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def old(*_: object, **__: object) -> None:
        raise RuntimeError(
            "The NVIDIA driver on your system is too old (found version 11040). Please update it."
        )

    monkeypatch.setattr(torch, "empty", old)
    with pytest.raises(
        ArgumentError, match=r"got 'cuda'; torch says: The NVIDIA driver .* \(found version 11040\)"
    ):
        Predictor(RIG, Flat(3, 8), min_depth=0.5, device="cuda")


@pytest.mark.parametrize(
    "asked",
    [
        lambda values: values[values > 0],
        lambda values: values.sum().item(),
        lambda values: values.nonzero(),
        lambda values: values.unique(),
        lambda values: values.masked_select(values > 0),
        lambda values: values.to("meta"),
    ],
)
def test_what_a_graph_cannot_hold_is_found_before_the_capture(asked: Callable[[Tensor], object]) -> None:
    with NoWaiting():
        _ = (torch.arange(4.0) * 2).sort().values[torch.arange(2)]
        with pytest.raises(RuntimeError, match=r"from the device|between the device"):
            asked(torch.arange(4.0))
