# SPDX-License-Identifier: Apache-2.0
"""The networks of ``conf/model`` side by side: parameters, arithmetic, and time for a frame of one input level."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.resources import files
from inspect import signature
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from sphericalvision.cameras import CameraRig, ring_rig
from sphericalvision.core import ArgumentError
from sphericalvision.icosphere import num_icosphere_vertices
from sphericalvision.models import IcoSweepNet
from sphericalvision.recipes.benchmark.measuring import Comparison
from sphericalvision.recipes.benchmark.ways import count_gflop

__all__ = ["comparisons", "gflop", "variant"]


def comparisons(config: DictConfig, device: torch.device) -> Iterator[Comparison]:
    """Whole inference of all ``config.variants`` at every setting ``[level, N]`` of ``config.settings``."""
    for level, number in config.settings:
        yield _inference(level, number, list(config.variants), device)


def variant(name: str, level: int, num_hypotheses: int) -> IcoSweepNet:
    """The network of ``conf/model/<name>.yaml``, for inference, at a level and a number of hypotheses.

    Raises:
        ArgumentError: there is no such file, or it describes another kind of network.

    Examples:
        >>> sum(parameter.numel() for parameter in variant("icosweepnet_rt", 4, 8).parameters())
        82413
    """
    folder = files("sphericalvision.conf") / "model"
    path = folder / f"{name}.yaml"
    if not path.is_file():
        known = sorted(
            entry.name.removesuffix(".yaml") for entry in folder.iterdir() if "icosweep" in entry.name
        )
        raise ArgumentError(
            f"variants: expected names of conf/model, such as {', '.join(known)}, got {name!r}"
        )
    options: dict[str, Any] = OmegaConf.to_container(OmegaConf.create(path.read_text()))  # type: ignore[assignment]
    if "aggregation" not in options:
        raise ArgumentError(f"variants: conf/model/{name}.yaml is no IcoSweepNet")
    options |= {"level": level, "num_hypotheses": num_hypotheses}
    return IcoSweepNet(
        **{key: options[key] for key in signature(IcoSweepNet).parameters if key in options}
    ).eval()


def _inference(level: int, number: int, names: list[str], device: torch.device) -> Comparison:
    rig = ring_rig(4).to(device)
    nets = {name: variant(name, level, number).to(device) for name in names}
    images = _images(level, device)
    costs = {name: gflop(net) for name, net in nets.items()}
    facts = [
        f"{name}: {sum(p.numel() for p in net.parameters()):,} parameters, {costs[name]:.4g} GFLOP, "
        f"1/{costs[names[0]] / costs[name]:.3g} of {names[0]}"
        for name, net in nets.items()
    ]
    runs = {name: _run(net, images, rig) for name, net in nets.items()}
    if device.type == "cuda":
        runs |= {f"{name}, bf16": _run(net, images, rig, torch.bfloat16) for name, net in nets.items()}
    return Comparison(
        f"level {level} to {level - 2}, N = {number}: networks", runs, names[0], note="; ".join(facts) + "."
    )


def _run(
    net: IcoSweepNet, images: Tensor, rig: CameraRig, dtype: torch.dtype | None = None
) -> Callable[[], Tensor]:
    tables = net.sweep.tables(rig)

    @torch.inference_mode()
    def run() -> Tensor:
        with torch.autocast(images.device.type, dtype, enabled=dtype is not None):
            return net(images, tables)

    return run


def _images(level: int, device: torch.device | str, dtype: torch.dtype = torch.float32) -> Tensor:
    return 2 * torch.rand(1, 4, 3, num_icosphere_vertices(level), device=device, dtype=dtype) - 1


def gflop(net: IcoSweepNet) -> float:
    """1e9 floating-point operations of a frame, done directly, without fast algorithms.

    Nothing is computed: the operations are only counted.
    """
    tables, images = net.sweep.tables(ring_rig(4)), _images(net.level, "cpu")
    net = IcoSweepNet(**net.hyperparameters).eval()
    return count_gflop(lambda: net(images, tables))
