# SPDX-License-Identifier: Apache-2.0
"""The page of a depth estimate in a browser: nothing is fetched, nothing complains, it turns, slides and orbits."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sphericalvision import Predictor
from sphericalvision.cameras import ring_rig
from sphericalvision.data import make_scene, render_rig
from sphericalvision.deploy.viewer import save_viewer


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rig = ring_rig(4, image_size=(96, 96))
    depth = Predictor(rig, method="semi_global", level=5, min_depth=0.5)(
        render_rig(make_scene("room", seed=1), rig)
    )
    return save_viewer(tmp_path_factory.mktemp("viewer") / "viewer.html", depth, 96, "a <room>")


def test_the_page_is_whole_in_itself(page: Path) -> None:
    text = page.read_text()
    body = text[: text.index("<script")]
    assert "a &lt;room&gt;" in body
    assert "__" not in body
    assert not re.search(r"""(src|href)=["']?https?:""", text)
    assert text.count("data:image/jpeg;base64,") == 3


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
def test_both_views_show_something_and_turn_when_dragged(opened: tuple[Any, list[str]], canvas: str) -> None:
    tab, complaints = opened
    before = picture(tab, canvas)
    assert before.std() > 5
    drag(tab, canvas)
    assert np.abs(picture(tab, canvas) - before).mean() > 1
    assert complaints == []


def test_the_slide_goes_from_image_to_depth_to_confidence(opened: tuple[Any, list[str]]) -> None:
    tab, complaints = opened
    seen = {}
    for value in ("0", "1", "2"):
        tab.locator("#slide").fill(value)
        tab.wait_for_timeout(300)
        seen[tab.locator("#shown").inner_text()] = picture(tab, "#panorama")
    assert list(seen) == ["image", "depth", "confidence"]
    assert all(np.abs(seen[a] - seen[b]).mean() > 5 for a, b in (("image", "depth"), ("depth", "confidence")))
    assert complaints == []
