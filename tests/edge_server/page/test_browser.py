"""The page in a real browser: live values, a picture, and nothing that fails."""

import pytest

from tests.edge_server.page.browser import Browser
from tests.edge_server.page.preview import Preview
from tests.edge_server.page.visitor import page_of

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def shown():
    """A preview with its page open in Chromium."""
    preview = Preview(silent=1)
    preview.start()
    with page_of(preview.state) as page, Browser(page.url, timeout_s=90.0) as browser:
        browser.wait_for_text("PSNR on cam04")
        browser.close_notices()
        yield preview, page, browser
    preview.stop()


def test_the_page_stays_live_and_asks_for_nothing_outside(shown):
    preview, page, browser = shown
    for part in ("live", "analytic", "worst age", "8/9", "Age of the newest frames", "truth at the present"):
        browser.wait_for_text(part)
    after = len(preview.state.publications())

    def counted() -> bool:
        lines = browser.text().splitlines()
        at = lines.index("updates") if "updates" in lines else -1
        return at >= 0 and int(lines[at + 1].split()[0]) > after

    browser.wait_for(counted, f"update {after + 1}")
    assert browser.errors == [] and browser.requests
    assert all(f":{page.port}" in address for address in browser.requests), browser.requests


def test_the_picture_shows_scene_cameras_and_panels(shown):
    _, _, browser = shown
    browser.wait_for(lambda: browser.screenshot()[250:650, 450:1150].std() > 15, "a picture of the scene")
    image = browser.screenshot()
    assert image.shape == (900, 1600, 3)
    orange = (image[..., 0] > 150) & (image[..., 0] > 1.4 * image[..., 2]) & (image[..., 1] < 190)
    assert orange[:, 360:1220].sum() > 1500  # the ball, in the scene
    violet = (image[..., 2] > 190) & (image[..., 0] > 100) & (image[..., 1] < 160)
    assert violet[:, 360:1220].sum() > 100  # the held-out camera's frustum
    assert image[:, :350].std() > 10 and image[:, 1240:].std() > 10  # both panels


def test_on_a_phone_the_scene_is_above_the_panels_and_nothing_is_clipped(shown):
    _, page, _ = shown
    with Browser(page.url, 390, 844, timeout_s=90.0) as phone:
        phone.wait_for_text("PSNR on cam04")
        size_of = "(({width, height}) => [width, height])(document.querySelector('%s').getBoundingClientRect())"
        assert phone.evaluate(size_of % "canvas") == phone.evaluate(size_of % ".mantine-Paper-root") == [390, 422]
        outside = "[...document.querySelectorAll('.mantine-Paper-root *')].filter((e) => e.innerText && %s).length"
        assert phone.evaluate(outside % "e.getBoundingClientRect().right > 391") == 0
        phone.close_notices()
        phone.click(100, 440)  # folds the panels up
        phone.wait_for(lambda: phone.evaluate(size_of % "canvas")[1] > 780, "a scene of the whole window")
