# SPDX-License-Identifier: Apache-2.0
"""The built site in a browser: every page, in both schemes, wide and narrow; and its search."""

import os
import re
import shutil
import statistics
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from html import unescape
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

from tests.documented import ROOT

pytestmark = pytest.mark.slow
playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
PAGES = sorted(
    page.relative_to(ROOT / "docs").with_suffix(".html").as_posix() for page in (ROOT / "docs").rglob("*.md")
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as a reader gets it."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A Chromium without a window."""
    if BROWSER is None:
        pytest.skip("needs Chromium")
    with playwright.sync_playwright() as driver:
        running = driver.chromium.launch(executable_path=BROWSER, args=FLAGS)
        yield running
        running.close()


@pytest.mark.parametrize(
    ("scheme", "width"), [("light", 1280), ("dark", 1280), ("light", 390), ("dark", 390)]
)
def test_pages_are_clean(site: Path, browser: Any, scheme: str, width: int) -> None:
    """No errors in the console, no request that leaves the disk, nothing wider than the window."""
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page, faults = context.new_page(), []
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on(
        "request",
        lambda request: (
            faults.append(request.url) if not request.url.startswith(("file:", "data:", "blob:")) else None
        ),
    )
    wrong = {}
    for name in PAGES:
        page.goto((site / name).as_uri())
        excess = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
        if excess > 0 or faults:
            wrong[name] = (excess, faults[:3])
        faults.clear()
    context.close()
    assert not wrong


def test_every_link_leads_somewhere(site: Path) -> None:
    """Anchors too, and links of text that is made while the site is built."""
    texts = {site / name: (site / name).read_text() for name in PAGES}
    anchors = {page: {*re.findall(r'\bid="([^"]+)"', text)} for page, text in texts.items()}
    dead = set()
    for page, text in texts.items():
        for link in re.findall(r'<a [^>]*?href="(?!https?:|mailto:)([^"]+)"', text):
            path, _, anchor = unescape(unquote(link)).partition("#")
            target = (page.parent / path).resolve() if path else page
            if not target.exists() or (anchor and anchor not in anchors.get(target, {anchor})):
                dead.add(f"{page.relative_to(site)}: {link}")
    assert not dead


SEARCHED = {
    "getting-started": "install, pip, docker, Windows, conda",
    "index": "license, licence, citation, BibTeX, commercial use",
    "how-do-i": "realtime, wandb, webcam, GoPro, insv, synchronization, EXR, rosbag, timestamp, base_link, LaTeX, "
    "TensorRT, metric scale, reprojection error, equirectangular to cubemap, checkpoint, point cloud, mesh, "
    "Gaussian splatting, stitch, fisheye calibration, undistort, mask, video, export tensorrt, lidar fusion, "
    "fisheye to equirectangular, kannala brandt jacobian, minimum baseline, rolling shutter, dual fisheye, "
    "Insta360, virtual pinhole views of a fisheye, z depth against range, AprilGrid, ChArUco, OmniPus",
    "conventions": "coordinate frame, depth map units, rotate panorama",
    "changelog": "changelog",
    "depth-benchmark": "how accurate",
    "where-it-fails": "sky",
    "guide/cameras": "double sphere model",
    "guide/gpu": "Jetson, CUDA",
    "guide/convolutions": "spherical CNN, gauge equivariant",
    "guide/predictor": "ONNX, ROS2 node, rviz, occupancy grid",
    "grids/cubemap": "cubemap seams",
    "grids/healpix": "HEALPix",
    "guide/scanned": "LiDAR truth, Helvipad, Deep360, KITTI-360",
    "formats/files": "Kalibr, nerfstudio, OCamCalib, colmap rig, fov of kitti360 fisheye",
    "recipes/configuration": "hyperparameter, hydra override list",
    "troubleshooting": "error message, batch size",
    "tutorials/cluster": "multi-GPU, multi gpu",
    "tutorials/cpp": "C++",
    "tutorials/five-minutes": "depth map",
    "tutorials/own-data": "fine-tune",
    "tutorials/own-lidar": "LiDAR, camera lidar extrinsic calibration",
    "tutorials/segmentation": "segmentation",
    "api/crown": "CrownConv",
}
"""Page -> what people type who look for it."""
ITEMS = "document.querySelectorAll('.md-search-result__item')"


def test_the_search_finds_the_page_among_the_first_three(site: Path, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto((site / "index.html").as_uri())
    box = page.locator("input.md-search__input")
    box.fill("camera")
    page.locator(".md-search-result__item").first.wait_for(timeout=60_000)  # the index is loaded
    missed = {}
    for address, phrases in SEARCHED.items():
        for phrase in phrases.split(", "):
            box.fill("qqqq")
            box.press("End")
            page.wait_for_function(f"{ITEMS}.length == 0")
            box.fill(phrase)
            box.press("End")
            with suppress(playwright.TimeoutError):
                page.wait_for_function(f"{ITEMS}.length > 0", timeout=10_000)
            first = page.evaluate(f"[...{ITEMS}].slice(0, 3).map((item) => item.querySelector('a').href)")
            if not any(f"/{address}.html" in link for link in first):
                missed[phrase] = first
    page.close()
    assert not missed


def test_pages_load_fast(site: Path) -> None:
    """With what a page loads at once, the search's index among it; pictures are loaded when they come into view."""
    index = (site / "search" / "search_index.js").stat().st_size
    assert index <= 800_000
    shared = index + sum(
        path.stat().st_size
        for end in ("*.css", "*.js")
        for path in (site / "assets").rglob(end)
        if "lunr" not in path.parts
    )
    assert shared + statistics.median((site / name).stat().st_size for name in PAGES) <= 1_200_000


def test_the_page_of_what_was_not_found_opens_from_disk(site: Path, browser: Any) -> None:
    page, lost = browser.new_page(), []
    page.on("requestfailed", lambda request: lost.append(request.url))
    page.goto((site / "404.html").as_uri())
    assert not lost
    assert page.evaluate("[...document.styleSheets].length") >= 3
    page.close()


CONTRAST = """() => {
  const numbers = (text) => text.match(/[\\d.]+/g).map(Number)
  const light = (color) => color
    .map((x) => (x / 255 <= 0.03928 ? x / 255 / 12.92 : ((x / 255 + 0.055) / 1.055) ** 2.4))
    .reduce((sum, x, i) => sum + x * [0.2126, 0.7152, 0.0722][i], 0)
  const ground = (node) => {
    for (; node; node = node.parentElement) {
      const color = numbers(getComputedStyle(node).backgroundColor)
      if (color.length < 4 || color[3] > 0.5) return color.slice(0, 3)
    }
    return [255, 255, 255]
  }
  const pale = []
  for (const link of document.querySelectorAll("a[href]:not(.headerlink)")) {
    if (!link.offsetParent || !link.textContent.trim()) continue
    const color = numbers(getComputedStyle(link).color), below = ground(link)
    let share = color.length > 3 ? color[3] : 1
    for (let node = link; node; node = node.parentElement) share *= +getComputedStyle(node).opacity
    const seen = below.map((x, i) => share * color[i] + (1 - share) * x)
    const [dark, bright] = [light(seen), light(below)].sort((a, b) => a - b)
    const ratio = (bright + 0.05) / (dark + 0.05)
    if (ratio < 4.5) pale.push([link.textContent.trim(), ratio])
  }
  return pale
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_links_stand_out(site: Path, browser: Any, scheme: str) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme=scheme)
    page = context.new_page()
    for name in ("index", "how-do-i", "api/geometry", "depth-benchmark"):
        page.goto((site / f"{name}.html").as_uri())
        assert page.evaluate(CONTRAST) == [], name
    context.close()


OUT_OF_SIGHT = """() => [...document.querySelectorAll("article th")].filter((head) =>
  /^refinedsweepnet/i.test(head.textContent.trim()) && head.getBoundingClientRect().right > innerWidth)
  .map((head) => head.closest("tr").textContent)"""


def test_our_own_column_is_in_sight_on_a_phone(site: Path, browser: Any) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 844})
    hidden = {}
    for name in PAGES:
        if "refinedsweepnet</th>" not in (site / name).read_text().lower():
            continue
        page.goto((site / name).as_uri())
        if heads := page.evaluate(OUT_OF_SIGHT):
            hidden[name] = heads
    page.close()
    assert not hidden
