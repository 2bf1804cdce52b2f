# SPDX-License-Identifier: Apache-2.0
"""What is built is what is in the tree: packages, configs, weights, console scripts and import layers."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MAPPED = {"sphericalvision.recipes": ROOT / "recipes", "sphericalvision.conf": ROOT / "conf"}


def run(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(part) for part in command], cwd=cwd, capture_output=True, text=True, check=False
    )


def copy_sources(target: Path) -> Path:
    """Copy what a build reads, so that the build leaves nothing behind in the working tree."""
    for name in ("sphericalvision", "recipes", "conf"):
        shutil.copytree(ROOT / name, target / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, target / name)
    return target


WEIGHTS = ROOT / "sphericalvision/models/weights"
STUDY = WEIGHTS / "study"
"""Weights that only the study and the benchmark need, or a training that goes on, and their cards: not in the wheel."""


@pytest.fixture(scope="module")
def wheel_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A freshly built wheel."""
    source = copy_sources(tmp_path_factory.mktemp("source"))
    command = (
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        source / "dist",
        source,
    )
    result = run(*command, cwd=source)
    assert result.returncode == 0, result.stdout + result.stderr
    (path,) = (source / "dist").glob("*.whl")
    return path


@pytest.fixture(scope="module")
def wheel(wheel_file: Path) -> set[str]:
    """Names of the files inside it."""
    with zipfile.ZipFile(wheel_file) as archive:
        return set(archive.namelist())


def test_wheel_is_light(wheel_file: Path, wheel: set[str]) -> None:
    assert wheel_file.stat().st_size < 12e6
    assert list(STUDY.glob("*.safetensors"))


def test_the_wheel_is_the_tree(wheel: set[str]) -> None:
    """All code, configs, shipped weights and their cards; no tests, caches, outputs or notes that lay about."""
    folders = ("sphericalvision", "recipes", "conf")
    listed = subprocess.check_output(["git", "ls-files", "-z", *folders], cwd=ROOT, text=True).split("\0")
    tree = {path for path in map(Path, filter(None, listed)) if (ROOT / path).exists()}
    expected = {path for path in tree if ROOT / path.parent != STUDY}
    expected = {p if p.parts[0] == "sphericalvision" else Path("sphericalvision", p) for p in expected}
    found = {Path(name) for name in wheel if ".dist-info/" not in name}
    assert found == expected, "add folders to [tool.setuptools] packages or package-data, and files to git"
    assert any(name.endswith("licenses/LICENSE") for name in wheel)


def test_declared_packages_are_the_folders_on_disk() -> None:
    on_disk = {
        ".".join(init.parent.relative_to(ROOT).parts)
        for init in (ROOT / "sphericalvision").rglob("__init__.py")
    }
    for name, folder in MAPPED.items():
        for init in folder.rglob("__init__.py"):
            on_disk.add(".".join((name, *init.parent.relative_to(folder).parts)))
    assert set(PYPROJECT["tool"]["setuptools"]["packages"]) == on_disk


def test_the_page_of_the_commands_names_every_console_script() -> None:
    text = (ROOT / "docs/recipes/index.md").read_text()
    missing = {name for name in PYPROJECT["project"]["scripts"] if f"{name} " not in text}
    assert not missing


@pytest.mark.parametrize("script", sorted(PYPROJECT["project"]["scripts"]))
def test_console_scripts_are_installed_and_loadable(script: str) -> None:
    (entry,) = metadata.entry_points(group="console_scripts", name=script)
    assert callable(entry.load())


def test_version_is_said_once_everywhere() -> None:
    import sphericalvision

    assert sphericalvision.__version__ == PYPROJECT["project"]["version"]
    assert f"version: {sphericalvision.__version__}" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.parametrize("url", [None, "https://example.org/me/it"])
def test_readme_of_a_release_has_no_relative_link(monkeypatch: pytest.MonkeyPatch, url: str | None) -> None:
    """An index has none of the files that README links to; with a URL they are found in that repository."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    from release import readme_for_index, with_urls

    text = readme_for_index((ROOT / "README.md").read_text(), "1.2", url)
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    assert all(target.startswith("https://") for target in targets), targets
    if url is None:
        assert "<picture>" not in text
        assert "follows one page of conventions and" in text
        return
    targets += re.findall(r' src(?:set)?="([^"]+)"', text)
    inside = [re.split(r"/(?:raw|blob)/v1\.2/", target)[1] for target in targets if target.startswith(url)]
    assert len(inside) > 5
    assert all((ROOT / path.partition("#")[0]).exists() for path in inside), inside
    urls = tomllib.loads(with_urls((ROOT / "pyproject.toml").read_text(), "1.2", url))["project"]["urls"]
    assert urls["Source"] == url
    assert urls["Paper"]


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    return run(Path(sys.executable).with_name("lint-imports"), "--no-cache", cwd=folder)


def test_import_layers_hold_and_a_breach_is_caught(tmp_path: Path) -> None:
    """The contract is kept by the tree, and broken when a camera imports Hydra or a layer above it.

    import-linter reads folders and knows nothing of setuptools' mapping, so the copy holds recipes and conf
    where an installed package has them (`make lint` does the same).
    """
    copy_sources(tmp_path)
    for name in ("recipes", "conf"):
        shutil.move(tmp_path / name, tmp_path / "sphericalvision" / name)
    clean = lint_imports(tmp_path)
    assert clean.returncode == 0, clean.stdout + clean.stderr

    (tmp_path / "sphericalvision" / "cameras" / "breach.py").write_text(
        "import hydra\nimport sphericalvision.models\n"
    )
    broken = lint_imports(tmp_path)
    assert broken.returncode != 0
    assert "sphericalvision.cameras.breach -> hydra" in broken.stdout
    assert "sphericalvision.cameras.breach -> sphericalvision.models" in broken.stdout


def test_mypy_refuses_an_untyped_function(tmp_path: Path) -> None:
    module = tmp_path / "untyped.py"
    module.write_text("def double(value):\n    return 2 * value\n")
    result = run(sys.executable, "-m", "mypy", "--config-file", ROOT / "pyproject.toml", module, cwd=tmp_path)
    assert result.returncode == 1, result.stdout + result.stderr
    assert "missing a type annotation" in result.stdout


def test_versions_to_be_audited_are_those_of_every_dependency() -> None:
    lines = (ROOT / "tests/versions.txt").read_text().splitlines()
    versions = dict(line.lower().replace("_", "-").split("==") for line in lines if not line.startswith("#"))
    project = PYPROJECT["project"]
    asked = [
        Requirement(text) for text in project["dependencies"] + project["optional-dependencies"]["recipes"]
    ]
    assert len(asked) > 10
    for requirement in asked:
        name = requirement.name.lower().replace("_", "-")
        if name != project["name"]:
            assert requirement.specifier.contains(versions[name]), requirement
