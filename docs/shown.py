# SPDX-License-Identifier: Apache-2.0
"""What the pages' own hidden lines use: files of this project, and pictures, as parts of a page.

MkDocs loads this file as a hook; ``on_config`` then makes it importable from the pages as ``shown``.
"""

from __future__ import annotations

import base64
import gc
import hashlib
import json
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.figure import Figure
from mkdocs.exceptions import PluginError
from mkdocs.plugins import event_priority
from mkdocs.utils import get_relative_url

import programs

QUALITY = 90
"""Of pictures in pages, as WebP files."""

SYNONYM_BOOST = 1000.0
"""Weight of other words for a section in the search; a title has 1000."""
BEGINNING = 240
"""Letters of an entry of the API that are searched: what it is for."""
PROGRAM = 2500
"""Letters of a block of code that is no longer searched."""
NUMBER = r"[-−+±]?[\d.,()%–×]+"
BRACKETS = r"(<td[^>]*>(?:<strong>)?[-−+±\d.,]+(?: ?%)?(?:</strong>)?) (\([^<>()]*\d[^<>()]*\))</td>"
"""What stands in brackets after a number in a table."""


def on_config(config: Any) -> None:
    """What MkDocs calls once it is configured."""
    sys.path.append(str(Path(__file__).parent))
    gc.set_threshold(50_000)  # a build keeps most of what it makes
    if page := os.environ.get("PAGE"):
        config.nav = [page]


def on_files(files: Any, config: object) -> None:
    """Start the programs of all pages, or of one, if the environment names it: its links lead nowhere then."""
    page = os.environ.get("PAGE")
    for file in files.documentation_pages() if page else []:
        if file.src_uri != page:
            files.remove(file)
    programs.start(files)


def on_build_error(error: Exception) -> None:
    """What is not needed any more does not run."""
    programs.stop()


def on_pre_build(config: object) -> None:
    """Pages write their pictures and files into an empty folder."""
    os.chdir(tempfile.mkdtemp())


def source(path: str, language: str = "yaml") -> str:
    """A file of this project as a block of code, titled with its name."""
    text = (
        (Path(__file__).parents[1] / path)
        .read_text()
        .removeprefix("# SPDX-License-Identifier: Apache-2.0\n")
    )
    name = path.removeprefix("tests/plugin/")
    return f'```{language} title="{name}"\n{text}```\n'


def html(picture: np.ndarray | Figure, alt: str) -> str:
    """An RGB picture (h, w, 3) or a figure as HTML; the page's own ``print`` is what markdown-exec collects."""
    if isinstance(picture, Figure):
        from figures import to_html

        for axes in picture.axes:
            for points in axes.collections:  # may be thousands
                points.set_rasterized(True)
        return to_html(picture, alt).replace("drawing", "drawing picture", 1)
    encoded = cv2.imencode(".png", picture[..., ::-1])[1].tobytes()
    return f'<img class="picture" alt="{alt}" src="data:image/png;base64,{base64.b64encode(encoded).decode()}">'


def embedded(page: Path, alt: str) -> str:
    """A page of the viewer as HTML: a button, in whose place it is loaded."""
    data = base64.b64encode(page.read_bytes()).decode()
    return f'<p><button class="md-button" data-viewer="{data}">{alt}</button></p>'


BOOSTS = {
    "how-do-i": 2.0,
    "tutorials/": 2.0,
    "getting-started": 2.0,
    "api/": 0.4,
    "recipes/keys/": 0.2,
}
"""How much more than others pages count in the search, by how their address begins."""


ASKED = r'<h([1-6]) id="([^"]+)">(?:(?!</h[1-6]>).)*</h[1-6]>\s*<!-- search: ([^>]*) -->'
"""A heading and, below it, what people call what stands there."""
SYNONYMS: dict[str, list[str]] = {}
"""Address of a section -> those words. They count as much as its title."""
UNREAD = re.compile(
    r'<details class="mkdocstrings-source">.*?</details>|<svg\b.*?</svg>', re.DOTALL
)
"""What nobody searches: the source of a function, a drawing."""
MARK = "<!-- unsearched -->"
UNSEARCHED: dict[str, list[str]] = {}
"""Address of a page -> what such marks stand for."""
PAGE = re.compile(r"<!-- page: (\S+) -->")
"""All that is in a page of the site that is a file of the repository's top level."""
FILES = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}


def of_repository(name: str) -> str:
    """Return a file of the repository as a page of the site; links to files that are no pages become text."""

    def link(match: re.Match[str]) -> str:
        target = FILES.get(match[2], match[2].removeprefix("docs/"))
        is_page = target != match[2] or match[2].startswith(("#", "http"))
        return f"[{match[1]}]({target})" if is_page else match[1]

    text = (
        (Path(__file__).parents[1] / name)
        .read_text()
        .replace('"docs/images/', '"images/')
    )
    return re.sub(r"\[([^\]]*)\]\(([^)\s]+)\)", link, text)


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    """Weigh the page for the search, and read it where it is a file of the repository."""
    programs.wait_for(page.file.src_uri)
    boost = next(
        (
            value
            for start, value in BOOSTS.items()
            if page.file.src_uri.startswith(start)
        ),
        1.0,
    )
    page.meta.setdefault("search", {}).setdefault("boost", boost)
    whole = PAGE.fullmatch(markdown.strip())
    return of_repository(whole[1]) if whole else markdown


@event_priority(50)  # before the search reads the page
def on_page_content(content: str, page: Any, **_: object) -> str:
    """What nobody searches is left out until the search has read it; brackets in a table stand below their number."""
    if "markdown_exec/_internal" in content:
        raise PluginError(
            f"{page.file.src_uri}: a block of the page raised, and its traceback is in the page"
        )
    content = re.sub(BRACKETS, r"\1<small>\2</small></td>", content)
    for level, heading, words in re.findall(ASKED, content):
        section = page.url if level == "1" else f"{page.url}#{heading}"
        SYNONYMS[section] = words.split(", ")
    UNSEARCHED[page.url] = re.findall(UNREAD, content)
    return re.sub(UNREAD, MARK, content)


@event_priority(-50)  # after the search has read the page
def on_page_context(context: object, page: Any, **_: object) -> None:
    """Put the sources and drawings back that the search has no need to parse, tag by tag."""
    pieces = iter(UNSEARCHED.pop(page.url, ()))
    page.content = re.sub(MARK, lambda _: next(pieces), page.content)


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Pictures inside a page become WebP files, which a browser loads when they come into view."""

    def file(match: re.Match[str]) -> str:
        data = base64.b64decode(match[2])
        name = f"images/made/{hashlib.sha256(data).hexdigest()[:16]}.webp"
        path = Path(config["site_dir"]) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), pixels, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
        place = get_relative_url(name, page.url)
        if match[1] == "src":
            height, width = pixels.shape[:2]
            return f'loading="lazy" width="{width}" height="{height}" src="{place}"'
        return f'{match[1]}="{place}"'

    def opened(match: re.Match[str]) -> str:
        data = base64.b64decode(match[1])
        name = f"images/made/{hashlib.sha256(data).hexdigest()[:16]}.html"
        path = Path(config["site_dir"]) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        frame = f"<iframe class=viewer title=viewer src={get_relative_url(name, page.url)}></iframe>"
        return f"onclick=\"this.outerHTML='{frame}'\""

    output = re.sub(r'data-viewer="([^"]+)"', opened, output)
    # Named attributes: a pattern of any name would be tried at each letter of the data.
    return re.sub(
        r'\b(src|xlink:href|href)="data:image/png;base64,([^"]{1500,})"',
        file,
        output,
    )


@event_priority(-50)  # after the search has written it, before it becomes a script
def on_post_build(config: Any, **_: object) -> None:
    """The search's index without what nobody searches, as each page loads it."""
    path = Path(config["site_dir"]) / "search" / "search_index.json"
    index = json.loads(path.read_text())
    index["config"].setdefault("fields", {})["tags"] = {"boost": SYNONYM_BOOST}
    for entry in index["docs"]:
        entry["text"] = searchable(entry["text"], entry["location"])
        words = SYNONYMS.get(entry["location"], [])
        if words:
            entry["tags"] = [*entry.get("tags", []), *words]
    path.write_text(json.dumps(index, separators=(",", ":"), ensure_ascii=False))


def searchable(text: str, location: str) -> str:
    """An entry's text: no markup, no rows of numbers, no whole programs; of generated pages the beginning, no code."""
    for code in re.findall(r"<pre>.*?</pre>", text, flags=re.DOTALL):
        if len(code) > PROGRAM or location.startswith("api/"):
            text = text.replace(code, " ")
    text = " ".join(re.sub(r"<[^>]*>", " ", text).split())
    text = re.sub(rf"(?<!\S){NUMBER}(?: {NUMBER})+(?!\S)", " ", text)
    return text[:BEGINNING] if location.startswith("api/") else text


def on_post_template(output: str, template_name: str, **_: object) -> str:
    """The page of what was not found opens from disk, too: its addresses begin in its own folder."""
    if template_name != "404.html":
        return output
    return re.sub(
        r'((?:href|src)="|"(?:base|search)": ")/(?=[\w.])', r"\1", output
    ).replace('"base": "/"', '"base": "."')
