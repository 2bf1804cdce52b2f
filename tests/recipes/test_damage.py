# SPDX-License-Identifier: Apache-2.0
"""Damaged checkpoints and broken disks are told in a paragraph."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from sphericalvision.core import FileFormatError
from sphericalvision.recipes.app.checkpoints import load_network
from sphericalvision.recipes.app.errors import plain_errors
from sphericalvision.recipes.training.run_folder import stored_network

DAMAGES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a list": lambda content: [content],
    "nothing": lambda content: None,
    "no state": lambda content: {**content, "state_dict": None},
    "no hyper-parameters": lambda content: {**content, "network_hyperparameters": None},
    "other hyper-parameters": lambda content: {**content, "network_hyperparameters": {"depth": 3}},
    "an unknown network": lambda content: {**content, "architecture": "nobody"},
    "not numbers": lambda content: {
        **content,
        "state_dict": {
            key: torch.full_like(value, torch.nan) for key, value in content["state_dict"].items()
        },
    },
}
FATAL = {"no hyper-parameters", "other hyper-parameters", "an unknown network"}
"""To prediction alone: resuming compares hyper-parameters with those of the run."""


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_checkpoints_are_refused(trained: Any, tmp_path: Path, damage: str) -> None:
    content = torch.load(trained.folder / "checkpoints/last.ckpt", weights_only=True)
    path = tmp_path / "damaged.ckpt"
    torch.save(DAMAGES[damage](content), path)
    with pytest.raises(FileFormatError, match=r"damaged\.ckpt"):
        load_network(path)
    if damage not in FATAL:
        with pytest.raises(FileFormatError, match=r"resume: .*damaged\.ckpt"):
            stored_network(path)


@pytest.mark.parametrize("kept", [0, 1, 100, 5000])
def test_cut_checkpoints_are_refused(trained: Any, tmp_path: Path, kept: int) -> None:
    path = tmp_path / "cut.ckpt"
    path.write_bytes((trained.folder / "checkpoints/last.ckpt").read_bytes()[:kept])
    for read in (load_network, stored_network):
        with pytest.raises(FileFormatError, match=r"cut\.ckpt"):
            read(path)


@pytest.mark.parametrize("key", ["optimizer_states", "loops", "global_step"])
def test_weights_alone_are_no_training_to_go_on_with(trained: Any, tmp_path: Path, key: str) -> None:
    content = torch.load(trained.folder / "checkpoints/last.ckpt", weights_only=True)
    del content[key]
    torch.save(content, tmp_path / "part.ckpt")
    with pytest.raises(FileFormatError, match=f"it lacks {key}"):
        stored_network(tmp_path / "part.ckpt")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.ENOTDIR])
def test_what_the_disk_refuses_is_one_paragraph(number: int, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped, plain_errors():
        raise OSError(number, "what the system says", "/somewhere/x.png")
    assert stopped.value.code == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("Error: /somewhere/x.png: what the system says; free the disk")
