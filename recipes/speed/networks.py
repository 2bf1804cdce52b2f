# SPDX-License-Identifier: Apache-2.0
"""Networks against the readable formulas of the same numbers, with each other, and on a GPU; planar convolutions."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from hydra import compose
from omegaconf import DictConfig
from torch import Tensor, nn

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.capture import Predictor
from sphericalvision.capture.graphs import GraphedFunction
from sphericalvision.crown import Crown, CrownConv2d, CrownConv3d, HexConv2d, HexConv3d, to_crown
from sphericalvision.data import ToSphere
from sphericalvision.icosphere import icosphere_vertices, num_icosphere_vertices
from sphericalvision.kernels import kernels
from sphericalvision.models import DepthNetwork, IcoSweepNet, SemiGlobalSweep, pretrained
from sphericalvision.recipes.app.cli import build
from sphericalvision.recipes.speed.measuring import OURS, Comparison, Run, added_memory, ways
from sphericalvision.scenes import make_scene, render_rig

PREDICTORS: dict[str, dict[str, Any]] = {
    "default": {},
    "level 5": {"level": 5},
    "level 7": {"level": 7},
    "default, bfloat16": {"precision": "bfloat16"},
    "default, float16": {"precision": "float16"},
}
"""Options of the predictors that are timed on a GPU; each level that stands alone is one of the networks, too."""
BATCHES = 1, 16
MAX_SIDE = 800
"""Height and width of the images on a GPU, at most."""


def random_images(level: int, device: torch.device, batch: int = 1) -> Tensor:
    """Images of four cameras on an icosphere."""
    return 2 * torch.rand(batch, 4, 3, num_icosphere_vertices(level), device=device) - 1


def network(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """All stages of the paper's network, and memory, at every setting ``[level, N]`` of ``config.settings``."""
    for level, number in config.settings:
        torch.manual_seed(0)
        rig = ring_rig(4, image_size=tuple(config.image_size)).to(device)
        net = IcoSweepNet(level, number, feature_channels=config.feature_channels).to(device).eval()
        label = f"level {level} to {level - 2}, N = {number}"
        images, tables = random_images(level, device), net.sweep.tables(rig)
        with torch.inference_mode():
            features = net.extract_features(images)
            volume = net.sweep(features, tables).values.flatten(1, 2)
        stages: dict[str, Run] = {
            "sweep tables of a new rig": partial(net.sweep.tables, rig),
            "features of four cameras": partial(net.extract_features, images),
            "cost volume": partial(net.sweep, features, tables),
            "regulariser": partial(net.regularizer, volume),
            "whole inference": partial(net, images, tables),
        }
        runs = {stage: ways(run, config.options, device) for stage, run in stages.items()}
        steps = training_steps(net, images, tables, config.options, device)
        for title, by_way in (runs | {"one training step, without the optimiser": steps}).items():
            yield Comparison(f"{label}: {title}", by_way)
        for title, by_way in {"inference": runs["whole inference"], "training": steps}.items():
            yield Comparison(
                f"{label}: memory that {title} adds",
                {name: partial(added_memory, run, device) for name, run in by_way.items()},
                "Peak above the memory of network, images and tables.",
                "MB",
            )
        yield _projection(level, rig, device)


def training_steps(
    net: DepthNetwork, images: Tensor, tables: Any, options: list[str], device: torch.device
) -> dict[str, Run]:
    """Forward and backward pass in training mode, by the ways of inference and with ``recompute``."""

    def step(recompute: bool = False) -> None:
        net.train().configure(recompute=recompute)
        net(images, tables).sum().backward()
        net.eval().configure(recompute=False).zero_grad()

    steps = ways(step, options, device, inference=False)
    return steps | {f"{OURS}, recompute": partial(step, recompute=True)}


def _projection(level: int, rig: CameraRig, device: torch.device) -> Comparison:
    """Four fisheye images onto the icosphere, against the interpolation alone at the same pixels."""
    directions = icosphere_vertices(level).to(device)
    height, width = next(iter(rig.cameras.values())).image_size
    images = {name: torch.rand(3, height, width, device=device) for name in rig.names}
    poses = zip(rig.cameras.values(), rig.world_from_camera, strict=True)
    pixels = torch.stack([camera.project(directions @ pose[:3, :3]).pixels for camera, pose in poses])
    grids = ((2 * pixels + 1) / torch.tensor([width, height], device=device) - 1)[:, None]
    stacked = torch.stack([*images.values()])
    runs = {
        "bare grid_sample": partial(F.grid_sample, stacked, grids, align_corners=False),
        "ToSphere, the rig seen before": partial(ToSphere(level).images, images, rig),
    }
    return Comparison(f"level {level}: projection of four fisheye images", runs)


def variants(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Inference and training steps of ``config.variants`` of conf/model at every setting, and the plain sweep."""
    for level, number in config.settings:
        rig, images = ring_rig(4).to(device), random_images(level, device)
        nets: dict[str, DepthNetwork] = {name: variant(name, level, number) for name in config.variants}
        sizes = [
            f"{name}: {sum(p.numel() for p in net.parameters()):,} parameters" for name, net in nets.items()
        ]
        inference: dict[str, Run] = {}
        steps: dict[str, Run] = {}
        for name, net in {**nets, "semi-global sweep": SemiGlobalSweep(level, number)}.items():
            tables = net.to(device).tables(rig)
            inference |= _named(name, ways(partial(net, images, tables), config.options, device))
            if name in nets:
                steps |= _named(name, training_steps(net, images, tables, config.options, device))
        label = f"level {level} to {level - 2}, N = {number}"
        yield Comparison(f"{label}: networks", inference, "; ".join(sizes) + ".")
        yield Comparison(f"{label}: one training step of networks, without the optimiser", steps)


def _named(name: str, runs: dict[str, Run]) -> dict[str, Run]:
    return {way.replace(OURS, name) if OURS in way else f"{name}, {way}": run for way, run in runs.items()}


def variant(name: str, level: int, num_hypotheses: int) -> IcoSweepNet:
    """The network of ``conf/model/<name>.yaml``, for inference, at a level and a number of hypotheses."""
    overrides = [f"model={name}", f"model.level={level}", f"model.num_hypotheses={num_hypotheses}"]
    net: IcoSweepNet = build(compose("train", overrides).model, "variants")
    return net.eval()


def gpu(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Parity, a frame of a ``Predictor``, forward passes and training steps; the most important first."""
    side = min(MAX_SIDE, max(config.image_sides))
    rig, ring = ring_rig(4, image_size=(side, side)), ring_rig(4).to(device)
    rendered = render_rig(make_scene("room", seed=1), rig)
    images = {name: (255 * image).byte() for name, image in rendered.items()}
    calls = {
        name: partial(Predictor(rig, min_depth=0.55, device=device, **options), images)
        for name, options in PREDICTORS.items()
    }

    def difference(name: str) -> float:
        """Difference of the index from that of the CPU in float32, in the mean over seen directions."""
        level = PREDICTORS[name].get("level")
        expected = Predictor(rig, level=level, min_depth=0.55, device="cpu")(images)
        return float((calls[name]().index.cpu() - expected.index)[expected.seen].abs().mean())

    yield Comparison(
        "the index on the device and on the CPU, in the mean",
        {name: partial(difference, name) for name in calls},
        unit="hypotheses",
    )
    yield Comparison(
        f"Predictor: a call with four images of {side} x {side} bytes on the host, until its answer is there",
        {name: partial(lambda call: call().index.cpu(), call) for name, call in calls.items()},
    )
    level, number = config.settings[-1]
    paper = partial(IcoSweepNet, level, number, feature_channels=config.feature_channels)
    nets: dict[str, Callable[[], DepthNetwork]] = {
        "default": pretrained,
        "level 5": partial(pretrained().with_changes, level=5),
        "level 7": partial(pretrained().with_changes, level=7),
        f"IcoSweepNet {level}/{number}": paper,
    }
    for batch in BATCHES:
        for name, make in nets.items():
            net = make().to(device).eval()
            inputs, tables = random_images(net.level, device, batch), net.tables(ring)
            yield Comparison(f"{name}: a forward pass of {batch}", _graphs(net, inputs, tables, device))
            if name == "default":
                steps = training_steps(net, inputs, tables, ["bf16"], device)
                del steps["plain"]  # takes a hundred times as long
                yield Comparison(f"{name}: a training step of {batch}", steps)


def _graphs(net: DepthNetwork, images: Tensor, tables: Any, device: torch.device) -> dict[str, Run]:
    """A forward pass through existing tables: eager, as a CUDA graph, and in half precision."""

    @torch.inference_mode()
    def forward(inputs: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        # a cache of casts would outlive the graph that it was filled in
        with torch.autocast(device.type, dtype, dtype != torch.float32, cache_enabled=False):
            return net(inputs, tables)

    runs: dict[str, Run] = {"eager": partial(forward, images)}
    for dtype in (torch.float32, torch.bfloat16, torch.float16):
        name, run = str(dtype).removeprefix("torch."), partial(forward, dtype=dtype)
        graphed = GraphedFunction(name, run) if device.type == "cuda" else run
        graphed(images)  # a CUDA graph is captured at the second call, the warm-up of measuring
        runs[f"graph, {name}" if device.type == "cuda" else name] = partial(graphed, images)
    return runs


def convolutions(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Forward and backward pass at every ``[level, channels]`` of ``convolution_settings``, against as many pixels.

    2D, and 3D of 16 hypotheses two levels coarser. There it is two volumes: for a single small one torch takes a
    convolution on the CPU that is several times slower.
    """
    layers: tuple[tuple[type, ...], ...] = (
        (nn.Conv2d, HexConv2d, CrownConv2d),
        (nn.Conv3d, HexConv3d, CrownConv3d),
    )
    for level, channels in config.convolution_settings:
        for size, batch, depth, (planar, hexagonal, crown) in (
            (level, 1, (), layers[0]),
            (level - 2, 2, (16,), layers[1]),
        ):
            if size < 0:
                continue
            vertices, rows = num_icosphere_vertices(size), 2 ** (size + 1)
            values = torch.randn(batch, channels, *depth, vertices, device=device)
            # as many pixels as there are vertices but the poles
            image = torch.randn(batch, channels, *depth, rows, 5 * rows // 2, device=device)
            runs: dict[str, Run] = {
                "planar": _gradient(planar(channels, channels, 3, padding=1, bias=False).to(device), image)
            }
            for name, layer, inputs in (
                ("hex along charts", hexagonal(channels, channels), values),
                ("crown, both directions", crown(channels, channels), to_crown(values)),
            ):
                runs[name] = _gradient(layer.to(device), inputs)
                if "layers" in config.options:
                    runs[f"{name}, layers"] = kernels("plain")(runs[name])
            hypotheses = "".join(f", {number} hypotheses" for number in depth)
            title = f"{batch} x {vertices} samples{hypotheses}, {channels} channels"
            yield Comparison(f"convolution, forward and backward: {title}", runs)


def _gradient(layer: nn.Module, values: Tensor | Crown) -> Run:
    """Apply a layer and derive by its input and its parameters."""
    tensors = values if isinstance(values, Crown) else (values,)
    inputs = [tensor.detach().requires_grad_() for tensor in tensors]
    argument = Crown(*inputs) if isinstance(values, Crown) else inputs[0]

    def outputs() -> list[Tensor]:
        result = layer(argument)
        return list(result) if isinstance(result, Crown) else [result]

    weights = [torch.randn_like(output) for output in outputs()]
    return lambda: torch.autograd.grad(outputs(), [*inputs, *layer.parameters()], weights)
