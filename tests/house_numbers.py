# SPDX-License-Identifier: Apache-2.0
"""Numbers of the house: how long, how wide and how deep it is. ``make house`` prints them; it reports, it is no gate.

python -m tests.house_numbers            # all of them
python -m tests.house_numbers --chain    # beside them the longest chain of imports, and the files of a frame
"""

import ast
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SUFFIXES = (".py", ".cpp", ".h")
FRAMES = """
import sys, threading
from collections import Counter
import torch
from sphericalvision.cameras import ring_rig, save_rig
from sphericalvision.io.images import write_image
from sphericalvision.recipes.predict import main
rig = ring_rig(4, 0.2, image_size=(64, 64))
save_rig(rig, "rig.yaml")
torch.manual_seed(0)
images = {name: torch.rand(3, 64, 64) for name in rig.names}  # of all frames, so that all take the same ways
for frame in range(int(sys.argv[1])):
    for name in rig.names:
        write_image(f"{frame}_{name}.png", images[name])
calls = Counter()
def seen(frame, event, arg):
    if event == "call" and frame.f_code.co_name != "<module>":
        calls[frame.f_code.co_filename] += 1
threading.setprofile(seen)
sys.setprofile(seen)
sys.argv = ["sphericalvision-predict", "calibration=rig.yaml", "images={frame}_{camera}.png", "output=out"]
main()
sys.setprofile(None)
for file, number in calls.items():
    print("CALLS", number, file)
"""
"""``sphericalvision-predict`` on frames of four small images, all else by default, and how often it calls functions of
each file."""


SAMPLE = """
import sys
from pathlib import Path
import torch
from hydra import compose, initialize_config_module
from sphericalvision.data.collate import collate_samples
from sphericalvision.recipes.commands.train import instantiate_run
words = ["experiment=refinedsweepnet/fusion", "data=random_rigs", "data.image_size=[48,48]"]
words += ["data.cache_dir=null", "trainer.accelerator=cpu"]
with initialize_config_module("sphericalvision.conf", version_base="1.3"):
    run = instantiate_run(compose("train", words), Path("run"))
run.module.log = lambda *names, **options: None
samples = run.data.dataset("train")
files = set()
def seen(frame, event, arg):
    if event == "call" and frame.f_code.co_name != "<module>":
        files.add(frame.f_code.co_filename)
for number in range(3):
    torch.manual_seed(number)
    sys.setprofile(seen if number == 2 else None)
    run.module.training_step(collate_samples([samples[number]]), 0)
sys.setprofile(None)
for file in files:
    print("CALLS", 1, file)
"""
"""The third sample of the training of the default network, from its seed to its loss, and the files that it passes."""


def files(*prefixes: str) -> list[Path]:
    """Files under version control whose paths begin so, Python and C++."""
    listed = subprocess.run(
        ["git", "ls-files", "--", *prefixes], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [ROOT / name for name in listed.stdout.splitlines() if name.endswith(SUFFIXES)]


def lines(*prefixes: str) -> int:
    return sum(path.read_text().count("\n") for path in files(*prefixes) if path.exists())


@cache
def modules() -> dict[str, Path]:
    """The product's modules by name, packages by their ``__init__``."""
    found = {}
    for path in files("sphericalvision", "recipes"):
        if path.suffix == ".py" and path.exists():
            parts = list(path.relative_to(ROOT).with_suffix("").parts)
            parts = ["sphericalvision", *parts] if parts[0] == "recipes" else parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def top_level_imports(module: str) -> set[str]:
    """Modules that importing one imports at once: not those inside functions, nor those for type checkers.

    A name that a package hands on lazily is found where the package's stub says.
    """
    found: set[str] = set()
    todo: list[ast.stmt] = list(ast.parse(modules()[module].read_text()).body)
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If):
            checking = "TYPE_CHECKING" in ast.unparse(node.test)
            todo += node.orelse if checking else [*node.body, *node.orelse]
        elif isinstance(node, ast.Try):
            todo += [*node.body, *(part for handler in node.handlers for part in handler.body)]
        elif isinstance(node, ast.ClassDef):
            todo += node.body
        elif isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                submodule = f"{node.module}.{alias.name}"
                found |= {node.module, submodule, *lazy_names(node.module).get(alias.name, ())}
    return {name for name in found if name in modules() and name != module}


@cache
def lazy_names(package: str) -> dict[str, tuple[str, ...]]:
    """Where the stub of a package says that its names are."""
    path = modules().get(package)
    stub = path.with_suffix(".pyi") if path is not None else None
    if stub is None or not stub.exists():
        return {}
    return {
        alias.name: (f"{package}.{node.module}",)
        for node in ast.walk(ast.parse(stub.read_text()))
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }


@cache
def chain(module: str) -> tuple[str, ...]:
    """The longest chain of imports that begins with a module, packages' ``__init__`` included."""
    return (module, *max((chain(other) for other in sorted(top_level_imports(module))), key=len, default=()))


def files_of_a_sample() -> list[str]:
    """Files of the product whose functions run between the seed of a training sample and its loss."""
    return sorted(calls_of(SAMPLE))


def files_of_a_frame() -> tuple[list[str], list[str]]:
    """Files of the product whose functions a prediction runs, and those that run once more for a frame more.

    The calibration is judged by three frames, however many there are.
    """
    three, four = calls_of(FRAMES, "3"), calls_of(FRAMES, "4")
    return sorted(four), sorted(file for file, number in four.items() if number > three.get(file, 0))


def calls_of(program: str, *words: str) -> dict[str, int]:
    """How often a program calls functions of each file, which it prints."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", program, *words]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stdout + done.stderr)
    counts = (line.split(maxsplit=2)[1:] for line in done.stdout.splitlines() if line.startswith("CALLS "))
    ours = tuple(f"{ROOT / folder}/" for folder in ("sphericalvision", "recipes"))
    return {str(Path(file).relative_to(ROOT)): int(calls) for calls, file in counts if file.startswith(ours)}


UNSAYING = (
    "found known wanted kept there given told left tried looks said shown made taken stated asked here both part parts "
    "place places share shares turn turns near middle words? ours theirs mine beside beyond ahead apart away"
)
"""Names of variables that do not say what they hold, as regular expressions."""
ASKING = r"\b(kernel_mode|prefer_fused|use_triton|fast_path_enabled|is_compiling)\("
"""Calls that ask which way to compute."""


def grepped(pattern: str, *options: str) -> list[str]:
    """Lines of the product's Python that match, or what ``options`` of ``git grep`` make of them."""
    command = ["git", "grep", "-hE", *options, pattern, "--", "sphericalvision/*.py", "recipes/*.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.splitlines()


def unsaying_variables() -> list[str]:
    """Lines that assign to a variable of such a name."""
    return grepped(rf"^\s*({'|'.join(UNSAYING.split())})(\s*:[^=]+)?\s*=[^=]")


def words_of_pages() -> int:
    """Words of the hand-written pages: not of the API and the keys."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    return sum(
        len(page.read_text().split())
        for page in pages
        if page.parent.name not in ("api", "keys") and "<!-- page: " not in page.read_text()
    )


def newest_wheel() -> str:
    """Size of the wheel that ``make dist`` built last."""
    wheels = sorted((ROOT / "dist").glob("*.whl"), key=lambda path: path.stat().st_mtime)
    return f"{wheels[-1].stat().st_size / 1e6:.1f} MB" if wheels else "none built (make dist)"


def longest_chain() -> tuple[str, ...]:
    return max((chain(module) for module in modules()), key=len)


def counted() -> dict[str, int]:
    """Numbers that no program has to be run for, by their names in the table of CONTRIBUTING."""
    return {
        "longest chain of imports": len(longest_chain()),
        "words of the pages": words_of_pages(),
        "files that ask for a kernel": len(grepped(ASKING, "-l")),
        "`mock.patch` in the product": len(grepped(r"mock\.patch")),
        "variables whose name does not say what they hold": len(unsaying_variables()),
    }


def main() -> None:
    used, frame = files_of_a_frame()
    for name, value in {
        "lines of the product": f"{lines('sphericalvision', 'recipes'):,}",
        "lines of tests": f"{lines('tests'):,}",
        "files that a prediction runs": len(used),
        "files that a frame passes": len(frame),
        "files of a training sample to its loss": len(files_of_a_sample()),
        **{name: f"{number:,}" for name, number in counted().items()},
        "wheel": newest_wheel(),
    }.items():
        print(f"{name:50} {value:>9}")
    if "--chain" in sys.argv:
        print("\nThe longest chain:", *longest_chain(), sep="\n  ")
        print("\nThe files of a frame:", *frame, sep="\n  ")
        print("\nThe other files of a prediction:", *sorted(set(used) - set(frame)), sep="\n  ")


if __name__ == "__main__":
    main()
