# SPDX-License-Identifier: Apache-2.0
"""The page of a depth estimate in a browser: nothing is fetched, nothing complains, it turns, slides and orbits."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sphericalvision import Predictor
from sphericalvision.cameras import ring_rig
from sphericalvision.capture import Depth, viewer
from sphericalvision.capture.viewer import Timeline, save_viewer
from sphericalvision.scenes import make_scene, ray_depth, render_rig


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rooms with their errors on a time line."""
    rig = ring_rig(4, image_size=(96, 96))
    predictor = Predictor(rig, method="semi_global", level=5, min_depth=0.5)
    timeline = Timeline(96, "a <room>")
    for seed in (1, 2):
        scene = make_scene("room", seed=seed)
        depth = predictor(render_rig(scene, rig))
        timeline.add(f"room {seed}", depth, truth=ray_depth(scene, rig.center, depth.directions))
    return timeline.save(tmp_path_factory.mktemp("viewer") / "viewer.html")


def test_the_page_is_whole_in_itself(page: Path) -> None:
    text = page.read_text()
    body = text[: text.index("<script")]
    assert "a &lt;room&gt;" in body
    assert "__" not in body
    assert not re.search(r"""(src|href)=["']?https?:""", text)
    assert text.count("data:image/jpeg;base64,") == 8 + 1  # the colour bar


@pytest.mark.parametrize(
    "name", ["</script><script>alert(1)</script>", "__SCRIPT__ __DATA__", "<!--<script>", "a\nb"]
)
def test_names_of_frames_are_data(name: str, tmp_path: Path) -> None:
    timeline = Timeline(16, title=name)
    timeline.add(name, small_depth())
    text = timeline.save(tmp_path / "page.html").read_text()
    before, _, rest = text.partition('<script type="application/json" id="data">')
    assert html.escape(name) in before
    assert "<script" not in before
    data, _, rest = rest.partition("</script>")
    assert json.loads(data)["frames"][0]["name"] == name
    assert "<" not in data
    assert rest.count("<script>") == 2


def test_images_of_one_frame_are_as_fine_as_the_cameras(tmp_path: Path) -> None:
    text = save_viewer(tmp_path / "page.html", small_depth(size=128), 16).read_text()
    sizes = [
        cv2.imdecode(np.frombuffer(base64.b64decode(url), np.uint8), cv2.IMREAD_COLOR).shape[:2]
        for url in re.findall('image/jpeg;base64,([^"]+)', text)
    ]
    bar, fine, *others = sizes
    assert bar == (8, 256)
    assert others == [(16, 32)] * 2
    assert 90 < fine[0] == fine[1] / 2 < 130  # 128 pixels for 220 degrees are 105 for 180


def small_depth(size: int = 16) -> Depth:
    rig = ring_rig(2, image_size=(size, size))
    images = {name: np.full((size, size), 9, np.uint8) for name in rig.names}
    return Predictor(rig, method="semi_global", level=3, min_depth=0.5)(images)


def test_a_time_line_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "MOST_FRAMES", 4)
    depth = small_depth()
    timeline = Timeline(16)
    for number in range(11):
        timeline.add(str(number), depth)
    text = timeline.save(tmp_path / "page.html").read_text()
    assert re.findall(r'"name": "(\d+)"', text) == ["0", "4", "8"]
    assert "error" not in text[: text.index("<script")]
    one = save_viewer(tmp_path / "one.html", depth, 16).read_text()
    assert one.count("data:image/jpeg;base64,") == 3 + 1


@pytest.fixture(scope="module")
def opened(page: Path) -> Iterator[tuple[Any, list[str]]]:
    """The page in a headless browser, and what it complained of or asked for."""
    playwright = pytest.importorskip("playwright.sync_api")
    browser_path = (
        shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    )
    if browser_path is None:
        pytest.skip("needs Chromium")
    complaints: list[str] = []
    with playwright.sync_playwright() as started:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = started.chromium.launch(executable_path=browser_path, args=flags)
        tab = browser.new_page(viewport={"width": 900, "height": 500})
        tab.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        tab.on("request", lambda r: complaints.append(r.url) if r.url.startswith("http") else None)
        tab.goto(page.as_uri())
        tab.wait_for_selector("body[data-ready=yes]", timeout=60_000)
        tab.wait_for_timeout(1000)
        yield tab, complaints
        browser.close()


@pytest.fixture
def tab(opened: tuple[Any, list[str]]) -> Iterator[Any]:
    """The page, of which nothing complains until the end of a test."""
    yield opened[0]
    assert opened[1] == []


def picture(tab: Any, canvas: str) -> np.ndarray:
    encoded = np.frombuffer(tab.locator(canvas).screenshot(), np.uint8)
    return cv2.imdecode(encoded, cv2.IMREAD_COLOR).astype(int)


def drag(tab: Any, canvas: str) -> None:
    box = tab.locator(canvas).bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.mouse.move(x, y)
    tab.mouse.down()
    tab.mouse.move(x - 120, y + 10, steps=4)
    tab.mouse.up()
    tab.wait_for_timeout(300)


@pytest.mark.parametrize("canvas", ["#panorama", "#cloud"])
def test_both_views_show_something_and_turn_when_dragged(tab: Any, canvas: str) -> None:
    before = picture(tab, canvas)
    assert before.std() > 5
    drag(tab, canvas)
    assert np.abs(picture(tab, canvas) - before).mean() > 1


def test_points_are_seen_from_outside_first_and_the_ceiling_is_cut_on_request(tab: Any) -> None:
    seen = [picture(tab, "#cloud")]
    for press in ("i", "c", "c", "i"):
        tab.locator("body").press(press)
        tab.wait_for_timeout(300)
        seen.append(picture(tab, "#cloud"))
    changed = [np.abs(before - after).mean() for before, after in pairwise(seen)]
    assert min(changed) > 1
    around = picture(tab, "#panorama")
    tab.locator("body").press("ArrowLeft")
    tab.wait_for_timeout(300)
    assert np.abs(picture(tab, "#panorama") - around).mean() > 1


def test_it_opens_half_photograph_half_depth_and_says_the_distance_under_the_pointer(tab: Any) -> None:
    tab.locator("#slide").fill("0.5")
    tab.wait_for_timeout(300)
    assert tab.locator("#shown").inner_text() == "image | depth"
    half = picture(tab, "#panorama")
    middle = half.shape[1] // 2
    for value, side in (("0", slice(0, middle - 2)), ("1", slice(middle + 2, None))):
        tab.locator("#slide").fill(value)
        tab.wait_for_timeout(300)
        assert np.abs(picture(tab, "#panorama") - half)[:, side].mean() < 1
    tab.locator("#panorama").hover()
    assert 0.3 < float(tab.locator("#metres").inner_text().removesuffix(" m")) < 10


def test_the_slide_goes_from_image_to_depth_to_confidence_to_error(tab: Any) -> None:
    seen = {}
    for value in ("0", "1", "2", "3"):
        tab.locator("#slide").fill(value)
        tab.wait_for_timeout(300)
        seen[tab.locator("#shown").inner_text()] = picture(tab, "#panorama")
    assert list(seen) == ["image", "depth", "confidence", "error"]
    assert all(np.abs(seen[a] - seen[b]).mean() > 5 for a, b in pairwise(seen))


def test_the_time_line_goes_from_frame_to_frame_and_plays(tab: Any) -> None:
    tab.locator("#slide").fill("0")
    shown = {}
    for value in ("1", "0"):
        tab.locator("#time").fill(value)
        tab.wait_for_selector(f"body[data-frame='{value}']", timeout=20_000)
        tab.wait_for_timeout(300)
        shown[tab.locator("#frame").inner_text()] = picture(tab, "#panorama"), picture(tab, "#cloud")
    assert list(shown) == ["room 2", "room 1"]
    for before, after in zip(*shown.values(), strict=True):
        assert np.abs(before - after).mean() > 1
    tab.locator("#play").click()
    tab.wait_for_selector("body[data-frame='1']", timeout=20_000)
    tab.wait_for_selector("body[data-frame='0']", timeout=20_000)
    tab.locator("#play").click()
