# SPDX-License-Identifier: Apache-2.0
"""Small changes of the code, and how many of them no quick test notices: ``make mutants``.

mutmut makes the changes, its own kinds and those of ``OPERATORS``, in the files of one room after the other, and tries
each against those of the room's tests that call the changed function. All changes would take days, so as many are drawn
for each room; the same code and seed draw the same ones. They are made in a copy, ``build/mutants``, where recipes lie
in the package that they are installed as: mutmut changes what is imported from its folder. Rooms and their tests are in
``ROOMS``.
Names of parametrized tests have to be ASCII: pytest, which is called again and again in one process, escapes what it
has escaped.

python -m tests.mutants --each 80 --seed 0     # draw, try, and show what survived
python -m tests.mutants --only data metrics    # of the rooms whose patterns have one of these words
python -m tests.mutants --list                 # only their names
"""

import argparse
import fnmatch
import json
import os
import random
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from math import sqrt
from pathlib import Path

import libcst as cst
from mutmut.mutation.file_mutation import mutate_file_contents
from mutmut.mutation.mutators import mutation_operators
from mutmut.stats import status_by_exit_code

TREE = Path("build/mutants")
MUTMUT = "import tests.mutants; from mutmut.__main__ import cli; cli()"
"""mutmut with the kinds of changes that are added here."""

CALIBRATING = [f"tests/capture/test_{name}.py" for name in ("boards", "calibrate_rig", "refine", "alignment")]
ROOMS = {
    "sphericalvision/sweep/*.py": ["tests/sweep", "tests/models"],
    "sphericalvision/cameras/rig.py": ["tests/cameras/test_rig.py", "tests/cameras/test_golden_rig.py"],
    "sphericalvision/capture/*.py": [
        "tests/capture",
        "captures",
        "predict",
        "predict_streams",
        "predict_moving",
        "align",
    ],
    "sphericalvision/models/*.py": ["tests/models"],
    "sphericalvision/capture/calibrating/*.py": [
        *CALIBRATING,
        "tests/capture/test_direct_alignment.py",
        "calibrate",
        "align",
    ],
    "sphericalvision/metrics/*.py": ["tests/metrics"],
    "sphericalvision/losses/*.py": ["tests/losses"],
    "sphericalvision/data/*.py": ["tests/data", "scanned"],
    "sphericalvision/scenes/rendering/*.py": ["tests/scenes"],
    "sphericalvision/recipes/evaluation/*.py": [
        "evaluation_laws",
        "evaluate",
        "depth_benchmark",
        "study",
        "rectified_sgbm",
    ],
}
"""Files, as patterns in which a star matches folders, too, and the tests that look after them, by path or by the name
of one of recipes."""


def exchanged_arguments(node: cst.Call) -> Iterator[cst.CSTNode]:
    """Two neighbours without a keyword."""
    for at, (first, second) in enumerate(zip(node.args, node.args[1:], strict=False)):
        is_plain = not (first.keyword or second.keyword or first.star or second.star)
        if is_plain and not first.value.deep_equals(second.value):
            pair = first.with_changes(value=second.value), second.with_changes(value=first.value)
            yield node.with_changes(args=[*node.args[:at], *pair, *node.args[at + 2 :]])


def dropped_conditions(node: cst.BooleanOperation | cst.BinaryOperation) -> Iterator[cst.CSTNode]:
    """One of two conditions or masks alone."""
    if isinstance(node.operator, cst.And | cst.Or | cst.BitAnd | cst.BitOr):
        for side in (node.left, node.right):
            yield side.with_changes(lpar=[cst.LeftParen(), *side.lpar], rpar=[*side.rpar, cst.RightParen()])


def other_units(node: cst.Call) -> Iterator[cst.CSTNode]:
    """An angle that is not converted, or a transform that is not inverted."""
    name = node.func.attr if isinstance(node.func, cst.Attribute) else node.func
    names = ("radians", "degrees", "deg2rad", "rad2deg", "invert_transform")
    if isinstance(name, cst.Name) and name.value in names and len(node.args) == 1:
        yield node.args[0].value


def other_frames(node: cst.Attribute) -> Iterator[cst.CSTNode]:
    """A pose the other way round, or a rotation that is not transposed."""
    if node.attr.value in (pair := ("world_from_camera", "camera_from_world")):
        yield node.with_changes(attr=cst.Name(pair[node.attr.value == pair[0]]))
    if node.attr.value in ("mT", "T"):
        yield node.value


OPERATORS = [
    (cst.Call, exchanged_arguments),
    (cst.BooleanOperation, dropped_conditions),
    (cst.BinaryOperation, dropped_conditions),
    (cst.Call, other_units),
    (cst.Attribute, other_frames),
]
"""Types of nodes and changes of them, as of ``mutation_operators``: faults that mutmut's own kinds do not make."""
assert isinstance(mutation_operators, list)
mutation_operators.extend(OPERATORS)


def copy_code() -> None:
    """The tracked files in `TREE`, with recipes inside of the package."""
    shutil.rmtree(TREE, ignore_errors=True)
    (TREE / "sphericalvision" / "recipes").mkdir(parents=True)
    (TREE / "recipes").symlink_to("sphericalvision/recipes")
    for name in subprocess.check_output(["git", "ls-files", "-z"], text=True).split("\0"):
        if name and Path(name).is_file():
            (TREE / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(name, TREE / name)


def mutants(pattern: str) -> list[str]:
    """The names of all changes of the files of a room."""
    names = []
    for path in sorted(Path("sphericalvision").rglob("*.py")):
        if fnmatch.fnmatch(str(path), pattern):
            module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
            made = mutate_file_contents(str(path), path.read_text()).mutant_names
            names += [f"{module}.{name}" for name in made]
    return names


def wilson(noticed: int, tried: int) -> tuple[float, float]:
    """The interval, of 95 %, around a share."""
    share, z = noticed / tried, 1.96
    centre, half = share + z * z / 2 / tried, z * sqrt(share * (1 - share) / tried + (z / 2 / tried) ** 2)
    return (centre - half) / (1 + z * z / tried), (centre + half) / (1 + z * z / tried)


def try_them(pattern: str, names: list[str]) -> set[str] | None:
    """Try the changes of a room, show those that no test notices, and say which are; None without a result."""
    tests = [test if "/" in test else f"tests/recipes/test_{test}.py" for test in ROOMS[pattern]]
    settings = {"only_mutate": [pattern], "pytest_add_cli_args_test_selection": tests}
    lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in settings.items())
    text = ORIGINAL.replace(HEADING, f"[tool.mutmut]\n{lines}")
    Path("pyproject.toml").write_text(text)
    shutil.rmtree("mutants", ignore_errors=True)  # with what it says of the tests of another room
    if subprocess.run([sys.executable, "-c", MUTMUT, "run", *names], check=False).returncode:
        return None
    exits: dict[str, int | None] = {}
    for meta in Path("mutants/sphericalvision").rglob("*.meta"):
        exits |= json.loads(meta.read_text())["exit_code_by_key"]
    ends = {name: status_by_exit_code[exits[name]] for name in names}
    # Suspicious is what ends otherwise: with such a change tests cannot even be collected.
    noticed = {name for name, end in ends.items() if end in ("killed", "timeout", "segfault", "suspicious")}
    for name in names:
        if name not in noticed:
            print(f"\n# {name}: {ends[name]}", flush=True)
            subprocess.run([sys.executable, "-m", "mutmut", "show", name], check=True)
    return noticed


def line(noticed: int, tried: int, total: int, room: str) -> str:
    """A line of the table."""
    low, high = wilson(noticed, tried)
    share = f"{noticed / tried:.0%} ({low:.0%} to {high:.0%})"
    return f"{noticed:4} / {tried:3} of {total:6,} {share:18} {room}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="how many small changes of the code no quick test notices")
    parser.add_argument("--each", type=int, default=80, help="changes that are tried of each room")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--list", action="store_true", help="print the names of the sample and end")
    parser.add_argument(
        "--only", nargs="*", default=[""], help="words of the patterns of rooms; all by default"
    )
    args = parser.parse_args()
    copy_code()
    os.chdir(TREE)
    ORIGINAL, HEADING = Path("pyproject.toml").read_text(), "[tool.mutmut]\n"
    assert HEADING in ORIGINAL
    counts, lines, broken = Counter[str](), [], []
    for room in (room for room in ROOMS if any(word in room for word in args.only)):
        every = mutants(room)
        sample = sorted(random.Random(args.seed).sample(every, min(args.each, len(every))))
        if args.list:
            print("\n".join(sample))
        elif (noticed := try_them(room, sample)) is None:
            broken.append(room)
        else:
            counts.update(noticed=len(noticed), tried=len(sample), total=len(every))
            lines.append(line(len(noticed), len(sample), len(every), room))
            print(f"\n{lines[-1]}", flush=True)
    if lines:
        print("\nnoticed / tried of all, their share and its interval of 95 %")
        print("\n".join([*lines, line(counts["noticed"], counts["tried"], counts["total"], "together")]))
    if broken:
        sys.exit(f"no result, since tests fail without a change: {', '.join(broken)}")
