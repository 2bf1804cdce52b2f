# SPDX-License-Identifier: Apache-2.0
"""Starting: a command imports what it uses, and answers what it can before anything heavy."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import torch

from sphericalvision.recipes.app.rigs import make_ring
from tests.processes import modules_after, python
from tests.recipes.tiny import typed, write_capture

PREDICT = "from sphericalvision.recipes.predict import main; main()"
LIGHTNING = ("pytorch_lightning", "lightning_fabric", "tensorboard", "torch._inductor")
SCENES = ("skimage", "kornia", "scipy")
COMMANDS = {
    "predict": (*LIGHTNING, *SCENES, "sklearn", "trimesh", "torch._dynamo", "matplotlib"),
    "export": ("pytorch_lightning", "tensorboard", "sklearn", "trimesh", "onnx"),
    "convert": (*LIGHTNING, *SCENES, "sklearn", "trimesh", "matplotlib"),
    "calibrate": (*LIGHTNING, *SCENES, "sklearn", "trimesh", "matplotlib"),
    "align": (*LIGHTNING, "skimage", "sklearn", "trimesh", "torch._dynamo"),
    "inspect": (*LIGHTNING, *SCENES, "sklearn", "trimesh"),
    "render": (*LIGHTNING, "sklearn", "trimesh", "matplotlib"),
    "demo": (*LIGHTNING, "sklearn"),
    "train": ("sklearn", "trimesh"),
    "evaluate": (*LIGHTNING, *SCENES, "torchmetrics", "sklearn", "trimesh", "matplotlib"),
}
"""Command -> what its work must not import; its files in ``recipes/commands`` import the rest."""

HEAVY = ("torch", "numpy", "kornia", "matplotlib", "pytorch_lightning", "sphericalvision.core")


def imported(program: str) -> set[str]:
    """Names of the modules that a program of its own ends up with."""
    report = f"{program}\nimport sys; print('\\nMODULES', *sys.modules)"
    return set(python("-c", report).rpartition("MODULES ")[2].split())


SLOW = ("train", "demo")


@pytest.fixture(scope="module")
def imports() -> Callable[[str], set[str]]:
    """The modules that the work of a command loads; those of the quick ones are asked for together."""
    quick = [command for command in COMMANDS if command not in SLOW]

    @cache
    def of(*commands: str) -> dict[str, set[str]]:
        programs = (f"import sphericalvision.recipes.commands.{command}" for command in commands)
        return dict(zip(commands, modules_after(*programs), strict=True))

    return lambda command: of(*([command] if command in SLOW else quick))[command]


@pytest.mark.parametrize(
    "command", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in COMMANDS]
)
def test_a_command_imports_only_what_it_uses(command: str, imports: Callable[[str], set[str]]) -> None:
    assert imports(command).isdisjoint(COMMANDS[command])


@pytest.mark.parametrize("command", [*COMMANDS, "study", "speed"])
def test_reading_the_command_line_imports_nothing_heavy(command: str) -> None:
    name = f"sphericalvision.recipes.{command}"
    program = f"import sys; sys.argv = ['x', '--help']; import {name} as c; c.main()"
    assert imported(program).isdisjoint(HEAVY)


BLURS_WITH = ("torch._dynamo", "torch._inductor", "sympy", "torch.fx.experimental.symbolic_shapes")
"""What comes along with kornia where cameras are aligned."""


@pytest.mark.slow
@pytest.mark.parametrize("align", [False, True])
def test_one_frame_is_predicted_without_what_it_does_not_need(
    weights: Path, tmp_path: Path, align: bool
) -> None:
    """Not only what the files import: what the work does, from the calibration to the point cloud."""
    rig = make_ring(image_size=(32, 32))
    write_capture(tmp_path, rig, {name: torch.rand(3, 32, 32) for name in rig.names}, file="{camera}.png")
    words = typed(f"x calibration=rig.yaml images={{camera}}.png checkpoint={weights} output=out height=16")
    words += (f"align={str(align).lower()}",)
    program = f"import os, sys; os.chdir({str(tmp_path)!r}); sys.argv = [*{words}]\n"
    modules = imported(program + PREDICT)
    assert (tmp_path / "out/points.ply").is_file()
    needless = {*COMMANDS["predict"], *BLURS_WITH} - ({*BLURS_WITH} if align else set())
    needless.discard("kornia")  # which turns rotations into matrices
    assert modules.isdisjoint(needless)


def test_rooms_of_the_package_are_there_after_a_bare_import() -> None:
    assert "torch" not in imported("import sphericalvision")
    assert "torch" in imported("import sphericalvision; sphericalvision.cameras.PinholeCamera")
    import sphericalvision

    rooms = {path.parent.name for path in Path(sphericalvision.__file__).parent.glob("*/__init__.py")}
    assert rooms <= set(dir(sphericalvision))
    with pytest.raises(AttributeError, match=r"attribute.*camera"):
        _ = sphericalvision.camera  # type: ignore[attr-defined]


def test_without_the_recipes_extra_one_line_says_what_to_install() -> None:
    program = f'import sys; sys.modules["omegaconf"] = sys.modules["hydra"] = None; {PREDICT}'
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert "pip install 'sphericalvision[recipes]'" in line


@pytest.mark.parametrize(
    "words", ["--version >&-", "--version <&- >&- 2>&-", "--version >/dev/full", "--cfg job >/dev/full"]
)
def test_an_output_that_takes_nothing_gets_no_traceback(words: str) -> None:
    command = f'env -u PYTHONUNBUFFERED {sys.executable} -c "{PREDICT}" {words}'
    result = subprocess.run(command, shell=True, stderr=subprocess.PIPE, text=True, check=False)
    assert result.returncode == ("full" in words)
    assert len(result.stderr.strip().splitlines()) == ("full" in words)


@pytest.mark.parametrize("word", ["--help", "--version"])
def test_a_reader_that_has_read_enough_is_no_fault(word: str) -> None:
    """``sphericalvision-predict --help | head -1``: the status of a program that a closed pipe ends, and no message.

    These are more and less than Python holds back before it writes.
    """
    with subprocess.Popen(
        [sys.executable, "-c", PREDICT, word], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait() == 128 + 13
