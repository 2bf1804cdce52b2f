# SPDX-License-Identifier: Apache-2.0
"""Small changes of the code, and how many of them no quick test notices: ``make mutants``.

mutmut makes the changes, in the files that ``[tool.mutmut]`` in pyproject.toml names, and tries each against the tests
that call the changed function. All of them would take days, so as many are drawn for each room; the same code and seed
draw the same ones. They are made in a copy, ``build/mutants``, where recipes lie in the package that they are installed
as: mutmut changes what is imported from its folder.

python -m tests.mutants --each 80 --seed 0     # draw, try, and show what survived
python -m tests.mutants --only data metrics    # of the rooms whose patterns have one of these words
python -m tests.mutants --list                 # only their names, for ``mutmut run`` and ``mutmut show`` there
"""

import argparse
import fnmatch
import json
import os
import random
import shutil
import subprocess
import sys
from math import sqrt
from pathlib import Path

from mutmut.configuration import config
from mutmut.mutation.file_mutation import mutate_file_contents
from mutmut.stats import status_by_exit_code

TREE = Path("build/mutants")


def copy_code() -> None:
    """The tracked files in `TREE`, with recipes inside of the package."""
    shutil.rmtree(TREE, ignore_errors=True)
    (TREE / "sphericalvision" / "recipes").mkdir(parents=True)
    (TREE / "recipes").symlink_to("sphericalvision/recipes")
    for name in subprocess.check_output(["git", "ls-files", "-z"], text=True).split("\0"):
        if name and Path(name).is_file():
            (TREE / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(name, TREE / name)


def mutants() -> dict[str, list[str]]:
    """The names of all changes, by the pattern of files that they are of."""
    rooms: dict[str, list[str]] = {pattern: [] for pattern in config().only_mutate}
    for path in sorted(Path("sphericalvision").rglob("*.py")):
        for room in (room for room in rooms if fnmatch.fnmatch(str(path), room)):
            module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
            rooms[room] += [
                f"{module}.{name}" for name in mutate_file_contents(str(path), path.read_text()).mutant_names
            ]
    return rooms


def wilson(noticed: int, tried: int) -> tuple[float, float]:
    """The interval, of 95 %, around a share."""
    share, z = noticed / tried, 1.96
    centre, half = share + z * z / 2 / tried, z * sqrt(share * (1 - share) / tried + (z / 2 / tried) ** 2)
    return (centre - half) / (1 + z * z / tried), (centre + half) / (1 + z * z / tried)


def drawn(each: int, seed: int, only: list[str]) -> dict[str, tuple[list[str], int]]:
    """A sample of the changes of each room, and how many there are."""
    return {
        room: (sorted(random.Random(seed).sample(names, min(each, len(names)))), len(names))
        for room, names in mutants().items()
        if any(word in room for word in only)
    }


def try_them(rooms: dict[str, tuple[list[str], int]]) -> None:
    """Try the changes, show those that no test notices, and print the table."""
    every = list(dict.fromkeys(name for names, _ in rooms.values() for name in names))
    subprocess.run([sys.executable, "-m", "mutmut", "run", *every], check=True)
    exits: dict[str, int | None] = {}
    for meta in Path("mutants/sphericalvision").rglob("*.meta"):
        exits |= json.loads(meta.read_text())["exit_code_by_key"]
    ends = {name: status_by_exit_code[exits[name]] for name in every}
    # Suspicious is what ends otherwise: with such a change tests cannot even be collected.
    noticed = {name for name, end in ends.items() if end in ("killed", "timeout", "segfault", "suspicious")}
    for name in every:
        if name not in noticed:
            print(f"\n# {name}: {ends[name]}", flush=True)
            subprocess.run([sys.executable, "-m", "mutmut", "show", name], check=True)
    print("\nnoticed / tried of all, their share and its interval of 95 %")
    for room, (names, total) in {
        **rooms,
        "together": (every, sum(total for _, total in rooms.values())),
    }.items():
        killed = len(noticed.intersection(names))
        low, high = wilson(killed, len(names))
        share = f"{killed / len(names):.0%} ({low:.0%} to {high:.0%})"
        print(f"{killed:4} / {len(names):3} of {total:6,} {share:18} {room}")


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
    sample = drawn(args.each, args.seed, args.only)
    if args.list:
        print("\n".join(name for names, _ in sample.values() for name in names))
    else:
        try_them(sample)
