"""The page in a real browser: live values, a picture, and nothing that fails."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.page import start_page
from tests.edge_server.page.browser import Browser
from tests.edge_server.page.preview import Preview

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def shown():
    """A preview with its page open in Chromium."""
    preview = Preview(silent=1)
    page = start_page(preview.state, "127.0.0.1", 0)
    preview.start()
    try:
        with Browser(page.url, timeout_s=90.0) as browser:
            browser.wait_for_text("PSNR")
            browser.wait_for_text("PSNR on cam04")
            browser.close_notices()
            yield preview, page, browser
    finally:
        page.stop()
        preview.stop()


def test_the_page_says_what_is_going_on_and_stays_live(shown):
    preview, _, browser = shown
    for part in (
        "live",
        "preview",
        "analytic",
        "mean age",
        "worst age",
        "8/9",
        "Age of the newest frames",
        "Fidelity at the present",
        "truth at the present",
        "no frame yet",
        "held out",
        "Cameras send frames over a bad network",
        "let this browser draw it",
    ):
        browser.wait_for_text(part)
    _until_updates(browser, after=len(preview.state.publications()))


def test_the_picture_shows_scene_cameras_and_panels(shown, tmp_path):
    _, _, browser = shown
    browser.wait_for(lambda: _center(browser.screenshot()).std() > 15, "a picture of the scene")
    image = browser.screenshot(tmp_path / "page.png")
    assert image.shape == (900, 1600, 3) and (tmp_path / "page.png").stat().st_size > 50_000
    orange = (image[..., 0] > 150) & (image[..., 0] > 1.4 * image[..., 2]) & (image[..., 1] < 190)
    assert orange[:, 360:1220].sum() > 1500  # the ball, in the scene
    violet = (image[..., 2] > 190) & (image[..., 0] > 100) & (image[..., 1] < 160)
    assert violet[:, 360:1220].sum() > 100  # the held-out camera's frustum
    assert image[:, :350].std() > 10 and image[:, 1240:].std() > 10  # both panels


def test_nothing_fails_and_nothing_outside_is_asked_for(shown):
    _, page, browser = shown
    browser.evaluate("1")  # lets events that are under way arrive
    assert browser.errors == []
    assert browser.requests
    assert all(f":{page.port}" in address for address in browser.requests), browser.requests


def test_on_a_phone_the_scene_is_above_the_panels_and_nothing_is_clipped(shown):
    _, page, _ = shown
    with Browser(page.url, 390, 844, timeout_s=90.0) as phone:
        phone.wait_for_text("PSNR on cam04")
        size_of = "(({width, height}) => [width, height])(document.querySelector('%s').getBoundingClientRect())"
        assert phone.evaluate(size_of % "canvas") == [390, 422]
        assert phone.evaluate(size_of % ".mantine-Paper-root") == [390, 422]
        assert phone.evaluate("document.title") == "freshfield"
        outside = "[...document.querySelectorAll('.mantine-Paper-root *')].filter((e) => e.innerText && %s).length"
        assert phone.evaluate(outside % "e.getBoundingClientRect().right > 391") == 0
        phone.close_notices()
        phone.wait_for(lambda: phone.screenshot()[120:300].std() > 15, "a picture of the scene")
        phone.click(100, 440)  # folds the panels up
        phone.wait_for(lambda: phone.evaluate(size_of % "canvas")[1] > 780, "a scene of the whole window")


def test_on_a_tablet_the_timelines_are_folded_up_until_they_are_wanted(shown):
    _, page, _ = shown
    with Browser(page.url, 768, 1024, timeout_s=90.0) as tablet:
        tablet.wait_for_text("PSNR on cam04")
        width = "document.querySelector('canvas').getBoundingClientRect().width"
        tablet.wait_for(lambda: tablet.evaluate(width) > 340, "a scene of half the window")
        assert "Age of the newest frames" not in tablet.text()
        tablet.close_notices()
        tablet.click_text("Timelines")
        tablet.wait_for_text("Age of the newest frames")
        assert tablet.evaluate(width) < 340  # and they stay


def _center(image: np.ndarray) -> np.ndarray:
    return image[250:650, 450:1150]


def _until_updates(browser: Browser, after: int) -> None:
    """The page counts more than ``after`` updates: its figures move."""

    def counted() -> bool:
        lines = browser.text().splitlines()
        at = lines.index("updates") if "updates" in lines else -1
        return at >= 0 and int(lines[at + 1].split()[0]) > after

    browser.wait_for(counted, f"update {after + 1}")
