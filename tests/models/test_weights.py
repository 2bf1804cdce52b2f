# SPDX-License-Identifier: Apache-2.0
"""Weights on disk: round trips, the authors' format, and what is said about broken files."""

from __future__ import annotations

import importlib
import json
import re
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from sphericalvision.core import ArgumentError, FileFormatError, MissingFileError
from sphericalvision.models import (
    IcoSweepNet,
    OmniMVS,
    RefinedSweepNet,
    load_reference_checkpoint,
    load_weights,
    pretrained,
    save_weights,
)
from sphericalvision.models.weights import available_weights
from sphericalvision.models.weights import files as weight_files
from sphericalvision.models.weights.checkpoints import read_network

Writer = Callable[..., Path]


def small_net() -> IcoSweepNet:
    torch.manual_seed(1)
    return IcoSweepNet(level=3, num_hypotheses=4, min_depth=0.3, feature_channels=2, num_cameras=2)


def in_reference_names(net: IcoSweepNet) -> dict[str, Tensor]:
    """Name weights as the authors do, written out by hand, index tables included."""
    renamed = {}
    for name, tensor in net.state_dict().items():
        key = name.replace("norm.", "bn.")
        for ours, theirs in (
            ("features.entry", "feature_extraction.conv1"),
            ("features.second", "feature_extraction.conv2"),
            ("features.fine", "feature_extraction.layer1"),
            ("features.coarse", "feature_extraction.layer2"),
            ("features.last", "feature_extraction.lastconv"),
            ("regularizer.fusion", "cost_regularization.dres0"),
            ("regularizer.blocks.0", "cost_regularization.dres1"),
            ("regularizer.blocks.1", "cost_regularization.dres2"),
            ("regularizer.blocks.2", "cost_regularization.dres3"),
            ("regularizer.blocks.3", "cost_regularization.dres4"),
            ("regularizer.reduction", "cost_regularization.classify.0"),
            ("regularizer.score", "cost_regularization.classify.1"),
        ):
            if key.startswith(ours + "."):
                key = theirs + key[len(ours) :]
        in_features = key.startswith(("feature_extraction.layer1", "feature_extraction.layer2"))
        first, second = ("convbn1", "convbn2") if in_features else ("0", "1")
        key = key.replace(".first.", f".{first}.").replace(".second.", f".{second}.")
        renamed[key] = tensor
    renamed["feature_extraction.conv1.conv.w1_index"] = torch.arange(7)
    return renamed


def same_weights(a: IcoSweepNet, b: IcoSweepNet) -> bool:
    state = b.state_dict()
    return all(torch.equal(tensor, state[name]) for name, tensor in a.state_dict().items())


def rewritten(path: Path, change: Callable[[dict[str, str], dict[str, Tensor]], object]) -> Path:
    """The same file with other metadata or weights."""
    with safe_open(path, framework="pt") as file:
        metadata, state = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    change(metadata, state)
    save_file(state, path, metadata)
    return path


WEIGHT = "features.last.weight"
STEPS = WEIGHT + weight_files.STEP


def a_step(state: dict[str, Tensor]) -> str:
    return next(name for name in state if name.endswith(weight_files.STEP))


def with_hyper_parameter(name: str, value: object) -> Callable[[dict[str, str], object], None]:
    def change(metadata: dict[str, str], _: object) -> None:
        metadata["hyperparameters"] = json.dumps(json.loads(metadata["hyperparameters"]) | {name: value})

    return change


BROKEN: dict[str, tuple[int, Callable[[Any, Any], object], str]] = {
    "a shape": (32, lambda _, x: x.update({WEIGHT: torch.zeros(5, 2, 7)}), rf"{WEIGHT}.*5, 2, 7.*32, 32, 7"),
    "a type": (32, lambda _, x: x.update({WEIGHT: x[WEIGHT].int()}), rf"{WEIGHT}.*int32.*float32"),
    "no numbers": (32, lambda _, x: x[WEIGHT].fill_(torch.nan), rf"not numbers.*{WEIGHT}"),
    "no metadata": (32, lambda metadata, _: metadata.clear(), "hyper-parameters"),
    "a format": (32, lambda metadata, _: metadata.update(format="sphericalvision-odd"), "'icosweepnet', .*got 'odd'"),
    "a file of others": (32, lambda metadata, _: metadata.update(format="pt"), "'pt', expected sphericalvision- and"),
    "a level": (32, with_hyper_parameter("level", 30), "level.*at most 10"),  # would take all memory
    "a level's type": (32, with_hyper_parameter("level", "deep"), "level: expected an integer"),
    "hypotheses": (32, with_hyper_parameter("num_hypotheses", -1), "num_hypotheses"),
    "a hyper-parameter": (32, with_hyper_parameter("odd", 1), "odd"),
    "other steps": (8, lambda _, x: x.update({(s := a_step(x)): x[s][:3]}), r"step' has shape \(3, .*expected"),
    "no steps": (8, lambda _, x: x.pop(a_step(x)), "holds torch.int8, expected torch.float32"),
    "steps of nothing": (8, lambda _, x: x.update({"odd.step": torch.ones(3)}), "step"),
    "steps of nothing, of floats": (32, lambda _, x: x.update({"odd.step": torch.ones(3)}), "step"),
    **{
        f"steps of steps, {bits}": (
            bits, lambda _, x: x.update({STEPS + k: torch.ones(32, 1, 1) for k in ("", ".step")}), "step"
        )
        for bits in (32, 8)
    },
}  # fmt: skip
"""What is wrong: bits of a file, how it is changed, and what is said."""


@pytest.mark.parametrize("name", BROKEN)
def test_broken_weights_say_what_does_not_fit(name: str, tmp_path: Path) -> None:
    bits, change, message = BROKEN[name]
    path = save_weights(IcoSweepNet(3, 4, feature_channels=32), tmp_path / "net.safetensors", bits)  # type: ignore[arg-type]
    with pytest.raises(FileFormatError, match=message):
        load_weights(rewritten(path, change))


def test_unreadable_weights_say_so(tmp_path: Path) -> None:
    path = tmp_path / "net.safetensors"
    with pytest.raises(MissingFileError, match=r"net\.safetensors"):
        load_weights(path)
    path.write_bytes(b"not weights at all")
    with pytest.raises(FileFormatError, match="load_reference_checkpoint"):
        load_weights(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("feature_channels", "100000"),  # a terabyte of weights, of which the file has none
        ("feature_channels", "1e3"),
        ("feature_channels", "[" * 3000),
        ("num_hypotheses", "1" + "0" * 30),
        ("refining_blocks", "10000000"),  # days of making layers
        ("blocks", "10000000"),
        ("feature_channels", "4000"),  # ten gigabytes
        ("widths", "[]"),
    ],
)
def test_damaged_hyper_parameters_cost_nothing(tmp_path: Path, name: str, value: str) -> None:
    small = RefinedSweepNet(3, 5, widths=[2, 2], blocks=1)
    path = save_weights(
        small if name not in small_net().hyperparameters else small_net(), tmp_path / "net.safetensors"
    )

    def damage(metadata: dict[str, str], state: dict[str, Tensor]) -> None:
        pattern = rf'("{name}": )(\[[^]]*\]|[^,}}]+)'
        metadata["hyperparameters"], found = re.subn(pattern, rf"\g<1>{value}", metadata["hyperparameters"])
        assert found == 1

    start, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FileFormatError, match=r"do not fit|cannot build|at most"):
        load_weights(rewritten(path, damage))
    assert time.process_time() - start < 30
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 600_000  # kilobytes


@pytest.mark.parametrize("wrapper", [torch.compile, torch.nn.DataParallel])
def test_a_wrapped_network_is_the_one_inside(tmp_path: Path, wrapper: Any) -> None:
    net = IcoSweepNet(level=3, num_hypotheses=4, feature_channels=2).eval()
    wrapped = wrapper(net)
    path = save_weights(wrapped, tmp_path / "net.safetensors")
    content = {"state_dict": {f"net.{name}": value for name, value in wrapped.state_dict().items()}}
    content |= {"architecture": "icosweepnet", "network_hyperparameters": net.hyperparameters}
    torch.save(content, tmp_path / "net.ckpt")
    for again in (load_weights(path), read_network(tmp_path / "net.ckpt")):
        assert all(torch.equal(a, b) for a, b in zip(again.parameters(), net.parameters(), strict=True))
        assert not again.training


def test_equal_weights_are_equal_files(tmp_path: Path) -> None:
    net = small_net()
    files = [save_weights(net, tmp_path / f"{k}.safetensors") for k in range(12)]
    assert len({path.read_bytes() for path in files}) == 1
    assert same_weights(load_weights(files[0]), net)


def test_a_full_disk_is_an_error_of_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise SafetensorError("I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(weight_files, "save_file", full)
    with pytest.raises(OSError, match=r"No space left.*net\.safetensors"):
        save_weights(small_net(), tmp_path / "net.safetensors")
    assert not list(tmp_path.iterdir())


def test_a_network_may_have_much_that_is_not_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As much as the bounds of its class allow."""
    net = OmniMVS(200, feature_channels=2, output_size=(8, 2048), num_scales=2)
    path = save_weights(net, tmp_path / "net.safetensors")
    assert same_weights(load_weights(path), net)
    monkeypatch.setattr(OmniMVS, "bounds", {"num_hypotheses": 199})
    with pytest.raises(FileFormatError, match=r"num_hypotheses.*199.*200"):
        load_weights(path)


def test_reference_checkpoint(write_checkpoint: Writer) -> None:
    net = small_net()
    path = write_checkpoint(state_dict=in_reference_names(net), ndisp=4, min_depth=0.3, level=3)
    again = load_reference_checkpoint(path)
    assert again.hyperparameters == net.hyperparameters
    assert same_weights(again, net)
    assert not again.training


def test_reference_checkpoint_at_another_level(write_checkpoint: Writer) -> None:
    net = small_net()
    # Saved from DataParallel
    state = {f"module.{key}": tensor for key, tensor in in_reference_names(net).items()}
    path = write_checkpoint(state_dict=state, ndisp=4, min_depth=0.3, level=3)
    again = load_reference_checkpoint(path, level=4, num_hypotheses=8, min_depth=0.5)
    assert (again.level, again.num_hypotheses, again.min_depth) == (4, 8, 0.5)
    assert same_weights(again, net)


def test_reference_checkpoint_without_settings(write_checkpoint: Writer) -> None:
    path = write_checkpoint(state_dict=in_reference_names(small_net()), ndisp=4, level=3)
    with pytest.raises(FileFormatError, match="'min_depth' is missing"):
        load_reference_checkpoint(path)
    assert load_reference_checkpoint(path, min_depth=0.3).min_depth == 0.3


def test_broken_reference_checkpoints_name_the_key(write_checkpoint: Writer) -> None:
    good = in_reference_names(small_net())
    settings: dict[str, Any] = {"ndisp": 4, "min_depth": 0.3, "level": 3}

    missing = {key: tensor for key, tensor in good.items() if key != "cost_regularization.dres2.1.bn.weight"}
    with pytest.raises(FileFormatError, match=r"blocks\.1\.second\.norm\.weight"):
        load_reference_checkpoint(write_checkpoint(state_dict=missing, **settings))

    foreign = good | {"backbone.conv.weight": torch.zeros(1)}
    with pytest.raises(FileFormatError, match=r"'backbone\.conv\.weight'.*another network"):
        load_reference_checkpoint(write_checkpoint(state_dict=foreign, **settings))

    wrong = good | {"feature_extraction.conv2.conv.weight": torch.zeros(2, 9, 7)}
    with pytest.raises(FileFormatError, match=r"features\.second\.conv\.weight.*\[2, 9, 7\]"):
        load_reference_checkpoint(write_checkpoint(state_dict=wrong, **settings))

    for key in ("feature_extraction.lastconv.weight", "cost_regularization.dres0.0.conv.weight"):
        without = {name: tensor for name, tensor in good.items() if name != key}
        with pytest.raises(FileFormatError, match="widths"):
            load_reference_checkpoint(write_checkpoint(state_dict=without, **settings))

    with pytest.raises(FileFormatError, match="'state_dict'"):
        load_reference_checkpoint(write_checkpoint(weights=good))
    with pytest.raises(FileFormatError, match="level"):
        load_reference_checkpoint(write_checkpoint(state_dict=good, **settings | {"level": 0}))


def test_a_pickle_with_code_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "code.pth"
    torch.save({"state_dict": {}, "hook": print}, path)
    with pytest.raises(FileFormatError, match=r"code\.pth"):
        load_reference_checkpoint(path)


def test_the_reference_itself_loads(reference: Any, write_checkpoint: Writer) -> None:
    path = write_checkpoint(state_dict=reference.state_dict, ndisp=8, min_depth=0.55, level=4)
    net = load_reference_checkpoint(path)
    assert net.hyperparameters == IcoSweepNet(level=4, num_hypotheses=8).hyperparameters


def test_shipped_weights_load() -> None:
    for name in available_weights():
        assert pretrained(name).num_cameras > 0


def test_weights_of_the_study_are_in_the_source_tree_or_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert pretrained("omnimvs-study").num_cameras == 4
    module = importlib.import_module("sphericalvision.models.weights.pretrained")
    monkeypatch.setattr(module, "_HERE", Path("nowhere"))
    with pytest.raises(MissingFileError, match=r"'omnimvs-study' .* not in the installed package.*checkout"):
        pretrained("omnimvs-study")


@pytest.mark.parametrize(("bits", "size", "error"), [(16, 0.8, 2**-11), (8, 0.4, 0.5 / 127)])
def test_fewer_bits_make_smaller_files_and_are_read_as_float32(
    tmp_path: Path, bits: Literal[16, 8], size: float, error: float
) -> None:
    net = IcoSweepNet(3, 4, feature_channels=32)
    with torch.no_grad():
        large = next(x for x in net.parameters() if x.numel() >= weight_files.LARGE)
        large[0], large[1, 0] = 0, 3.0  # an output without weights, and one with an outlier
    full, small = (save_weights(net, tmp_path / f"{b}.safetensors", b) for b in (32, bits))
    assert small.stat().st_size < size * full.stat().st_size
    again = load_weights(small)
    assert {x.dtype for x in again.state_dict().values() if x.is_floating_point()} == {torch.float32}
    for name, tensor in net.state_dict().items():
        of_its_output = tensor.abs().reshape(len(tensor), -1).amax(1) if tensor.dim() else tensor.abs()
        off = (again.state_dict()[name] - tensor).abs().reshape(*of_its_output.shape, -1).amax(-1)
        assert (off <= error * 1.001 * of_its_output + 2**-24).all(), name


@pytest.mark.parametrize("bits", [32, 16, 8])
@pytest.mark.parametrize("value", [1e5, 6.6e4, 3e38, 1e-30])
def test_what_is_written_can_be_read(tmp_path: Path, bits: Literal[32, 16, 8], value: float) -> None:
    """Numbers that half precision does not hold stay in single precision."""
    net = IcoSweepNet(3, 4, feature_channels=32)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.view(-1)[0] = value
    again = load_weights(save_weights(net, tmp_path / "net.safetensors", bits))
    for name, parameter in again.named_parameters():
        found = parameter.view(-1)[0].item()
        assert found == pytest.approx(value, rel=2e-3, abs=1e-7), name


class Forwarding(IcoSweepNet):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)


def test_a_network_with_nameless_arguments_is_rebuilt_by_names_or_refused() -> None:
    options = {"num_hypotheses": 4, "feature_channels": 2, "num_cameras": 2}
    net = Forwarding(level=3, **options)
    assert net.hyperparameters == {"level": 3, **options}
    assert net.with_changes(level=4).level == 4
    with pytest.raises(ArgumentError, match=r"^\*args: expected arguments with names, .* got \(3,\)"):
        _ = Forwarding(3, **options).hyperparameters
