# SPDX-License-Identifier: Apache-2.0
"""The paper's table row of a checkpoint: ``sphericalvision-evaluate checkpoint=... data=...``."""

from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from pydantic import with_config
from torch import Tensor
from torch.utils.data import Subset
from typing_extensions import TypedDict

from sphericalvision.cameras.fingerprint import rig_fingerprint
from sphericalvision.capture.preparation.own_body import MOST
from sphericalvision.capture.preparation.preparation import AS_IT_IS, Preparation
from sphericalvision.core import ArgumentError, check_choice
from sphericalvision.icosphere import Icosphere
from sphericalvision.models import DepthNetwork
from sphericalvision.models.weights.checkpoints import read_network
from sphericalvision.recipes.app.captures import with_own_body_masked
from sphericalvision.recipes.app.cli import build, choose_device, print_config, track
from sphericalvision.recipes.app.kinds import STRICT, Device, Fraction, Number, OnlyWith, Positive, Text
from sphericalvision.recipes.datamodules.data_module import SampleDataModule
from sphericalvision.recipes.datamodules.depth_data_module import DepthDataModule
from sphericalvision.recipes.evaluation.loop import (
    SampleFrames,
    VertexErrors,
    evaluate,
    limit_text,
    mean_errors_by_method,
)
from sphericalvision.recipes.evaluation.methods import (
    AsUsed,
    Method,
    Scale,
    baselines,
    camera_images,
    check_names,
    make_method,
    training_depths,
)
from sphericalvision.recipes.evaluation.strips import StripErrors, table_with_published
from sphericalvision.recipes.evaluation.tables import Table, save_errors


@with_config(STRICT)
class EvaluateKeys(TypedDict, total=False):
    """Keys of ``conf/evaluate.yaml``; those that are ``Any`` are compared with what their parts take."""

    rig: Annotated[Any, OnlyWith("data.rig", "data=scenes")]
    data: Annotated[Any, OnlyWith("data.mesh", subkeys=("mesh_up", "mesh_scale"))]
    photometric: bool
    align: bool
    output: Text
    checkpoint: Text | None
    split: Literal["train", "val", "test"]
    baselines: bool
    methods: list[str]
    model: Any
    masks: Literal["auto"] | None
    min_confidence: Fraction
    max_depth_m: Positive | Literal["auto"]
    device: Device
    seed: Number


SEARCHED = ("auto", "scene")
"""Values of ``model.min_depth`` that ``Predictor`` searches in each frame."""


def evaluate_checkpoint(config: Annotated[DictConfig, EvaluateKeys], folder: Path) -> Table:
    """Evaluate as ``config`` says; the table goes to ``folder`` as ``metrics.md``, ``.json`` and ``.csv``.

    The data are in the level and scale of the network, unless ``config.model`` says otherwise. A network on panoramas
    has no level; it is evaluated at the vertices of level 3 unless ``model.level`` says otherwise.
    """
    torch.manual_seed(config.seed)
    net = read_network(config.checkpoint)
    min_depth, level = config.model.min_depth, config.model.level
    searched = isinstance(min_depth, str)  # in each frame, by ``Predictor``
    if searched:
        check_choice("model.min_depth", min_depth, SEARCHED)
    net = net.with_changes(
        level=level if net.images == "sphere" else None, min_depth=None if searched else min_depth
    ).to(choose_device(config.device))
    OmegaConf.update(config, "model.level", net.level if net.images == "sphere" else level or 5)
    OmegaConf.update(config, "model.min_depth", net.min_depth)
    preparation = Preparation(config.photometric, config.align)
    as_used = bool(searched or config.masks or preparation != AS_IT_IS)
    data = _data_of(config, net, as_used)
    level, scale = config.model.level - 2, Scale(net.num_hypotheses, net.min_depth)
    print_config(config, folder)
    data.render(config.split)
    frames = data.plain_train_dataset() if config.split == "train" else data.dataset(config.split)
    name = type(net).__name__ if config.checkpoint is None else Path(config.checkpoint).stem
    methods = [Method(name, net, config.min_confidence)]
    if as_used:
        masks = _masks(data.loader(frames)) if config.masks else {}
        methods = [
            AsUsed(
                name,
                net,
                config.min_confidence,
                min_depth if searched else net.min_depth,
                preparation,
                lambda rig: rig.replaced(masks=masks or rig.masks),
            )
        ]
    if config.baselines:
        depths = training_depths(data, config.model.level)
        methods += baselines(scale, config.model.level, track(depths, "training depths", total=len(depths)))
    methods += [_compared_method(word, config.model.level, scale) for word in config.methods]
    check_names(methods)
    if len(methods) > 1 and (as_used or config.min_confidence > 0):
        print(f"Note: masks, preparation, min_depth and min_confidence apply to {name} alone")
    nothing = torch.zeros(1, *net.grid.shape, device=net.device)
    within = net.index_at(nothing, Icosphere(level, device=net.device).vertices)[1]
    published = getattr(data, "published", None)
    limit = config.max_depth_m if config.max_depth_m != "auto" else getattr(data, "max_depth", "auto")
    measure = (StripErrors if published else VertexErrors)(scale, level, net.device, within, limit)
    samples = SampleFrames(lambda numbers: data.loader(Subset(frames, numbers)), len(frames))
    records = evaluate(methods, samples, measure)
    if records[name].means["points"]["kept"] == 0:
        raise ArgumentError(
            f"min_confidence={config.min_confidence:g}: {name} is less confident at all points; set less"
        )
    table = save_errors(
        folder / "metrics",
        f"{config.split}, {len(frames)} frame(s), level {config.model.level}, percent of N = {net.num_hypotheses}; "
        f"AbsRel, d<1.25 {limit_text(limit)}",
        mean_errors_by_method(records),
    )
    if published:
        comparison = table_with_published(records, published)
        comparison.print()
        comparison.save(folder / "published", ".md", ".csv")
    for sentence in data.left_out():
        print(f"Warning: {sentence}")
    print(f"Saved in {folder}")
    return table


def _data_of(config: DictConfig, net: DepthNetwork, as_used: bool) -> SampleDataModule:
    """The data that ``config`` names, with the entries that the network and methods to compare take.

    ``as_used`` says whether camera images are needed, too.
    """
    data: SampleDataModule = build(config.data, "data")
    overrides = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    for key in (word.partition("=")[0] for word in overrides):
        if key in [f"data.{name}" for name in data.of_training]:
            raise ArgumentError(f"{key}: counts only in training; leave it out")
    entries = ["sphere" if config.baselines or config.methods else "depth", *(["fisheye"] if as_used else [])]
    data.bind_network(net, *entries, depth_level=config.model.level - 2)
    if as_used and not (isinstance(data, DepthDataModule) and data.view.images):
        raise ArgumentError(
            f"data: preparation, masks and model.min_depth=auto or scene need camera images (the entry 'fisheye'), "
            f"which samples of {type(data).__name__} do not hold; take other data, or leave them out"
        )
    return data


def _compared_method(word: str, level: int, scale: Scale) -> Method:
    """A method that is compared with a network, on the same images on the icosphere."""
    method = make_method(word, level, scale)
    if method.net.images != "sphere":
        raise ArgumentError(
            f"methods: {word} needs camera images, so it cannot be compared here; evaluate it by checkpoint={word}"
        )
    return Method(method.name, method.net.with_changes(level=level))


def _masks(batches: Iterable[dict[str, Any]]) -> Mapping[str, Tensor]:
    """Masks of the rig's own body, found in up to fifty frames of one rig."""
    frames = list(islice((frame for batch in batches for frame in camera_images(batch)), MOST))
    rig = frames[0][0]
    if any(rig_fingerprint(other) != rig_fingerprint(rig) for other, _ in frames):
        raise ArgumentError(
            "masks: auto masks what stands still in the frames of one rig, and these have several"
        )
    return with_own_body_masked(rig, (images for _, images in frames)).masks
