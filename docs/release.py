# SPDX-License-Identifier: Apache-2.0
"""The sources as a release has them, without links that lead nowhere: ``python docs/release.py FOLDER [URL]``.

``make dist`` builds from FOLDER. A package index shows the README, but has none of the files that it links to. With the
URL of a repository, such as https://github.com/you/sphericalvision, links lead to that repository, at the tag of the
version, and [project.urls] names it. Without a URL only the words of such links are left, and pictures go.
"""

from __future__ import annotations

import re
import shutil
import sys
import tomllib
from pathlib import Path

__all__ = ["readme_for_index", "with_urls"]

ROOT = Path(__file__).resolve().parents[1]
PICTURE = re.compile(r"^<picture>\n.*?</picture>\n\n?", re.MULTILINE | re.DOTALL)
"""A picture in the text."""
RELATIVE = re.compile(
    r"(?P<image>!?)\[(?P<text>[^\]]*)\]\((?!https?:|mailto:|#)(?P<path>[^)\s]+)\)"
)


def readme_for_index(text: str, version: str, url: str | None = None) -> str:
    """The README with links into the repository, or without them."""

    if url is None:
        return RELATIVE.sub(r"\g<text>", PICTURE.sub("", text))

    def link(match: re.Match[str]) -> str:
        kind = "raw" if match["image"] else "blob"
        return f"{match['image']}[{match['text']}]({url}/{kind}/v{version}/{match['path']})"

    text = re.sub(r'(src|srcset)="(?!https?:)', rf'\1="{url}/raw/v{version}/', text)
    return RELATIVE.sub(link, text)


def with_urls(pyproject: str, version: str, url: str) -> str:
    """pyproject.toml with the repository's addresses in [project.urls]."""
    added = f'Source = "{url}"\nIssues = "{url}/issues"\nChangelog = "{url}/blob/v{version}/CHANGELOG.md"\n'
    return pyproject.replace("[project.urls]\n", "[project.urls]\n" + added, 1)


def main(folder: Path, url: str | None = None) -> None:
    """Copy what a build reads, with the README for an index."""
    if url is not None and not re.fullmatch(r"https://[^\s/\"]+/\S*[^\s/\"]", url):
        sys.exit(
            f"URL: expected a repository such as https://github.com/you/sphericalvision, got {url}"
        )
    shutil.rmtree(folder, ignore_errors=True)
    for name in ("sphericalvision", "recipes", "conf"):
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    shutil.copy(ROOT / "LICENSE", folder)
    pyproject = (ROOT / "pyproject.toml").read_text()
    version = tomllib.loads(pyproject)["project"]["version"]
    (folder / "pyproject.toml").write_text(
        with_urls(pyproject, version, url) if url else pyproject
    )
    (folder / "README.md").write_text(
        readme_for_index((ROOT / "README.md").read_text(), version, url or None)
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), *(word.rstrip("/") for word in sys.argv[2:] if word))
