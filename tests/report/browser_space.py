"""The volume in 3D in a real browser, whose WebGL2 may run on the processor: `make test-browser`."""

import base64
import io
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page
from report.browser import SOFTWARE, WITHOUT_WEBGL, launch, launched, watched

from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.io import write_volume
from phyradgs_cl.report import write_report

EDGE, SIDE_MM, RADIUS_MM = 24, 12.0, 4.0
CENTRES = np.array([[-5.0, -5.0, -5.0], [5.0, -5.0, 5.0]])  # x, y, z mm: outside the ball


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with launched(*SOFTWARE) as browser:
        yield browser


@pytest.fixture(scope="module")
def ball() -> np.ndarray:
    """A ball (z, y, x) whose values fall from 1 at its middle to 0.5 at its surface, and a brighter bar at one side."""
    at = (np.arange(EDGE) + 0.5) / EDGE * SIDE_MM - SIDE_MM / 2
    r = np.sqrt(sum(a**2 for a in np.meshgrid(at, at, at, indexing="ij")))
    volume = np.clip(1 - 0.5 * r / RADIUS_MM, 0, 1) * (r < 1.4 * RADIUS_MM)
    volume[3:6, 10:14, 18:22] = 1.5
    return volume.astype(np.float32)


@pytest.fixture(scope="module")
def address(ball, tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("space")
    cloud = Gaussians(CENTRES, np.full((2, 3), 0.2), np.tile([1.0, 0, 0, 0], (2, 1)), np.ones(2))
    write_volume(folder / "ball.h5", ball, Grid.cube(EDGE, SIDE_MM), {}, cloud)
    write_report(folder / "ball.h5", folder / "page.html", lambda: None)
    return (folder / "page.html").as_uri()


@pytest.fixture
def page(browser, address) -> Iterator[Page]:
    trouble: list[str] = []
    page = watched(browser.new_page(viewport={"width": 560, "height": 480}), address, trouble)
    page.wait_for_selector("#space[data-drawn]")
    page.locator("#space").evaluate("canvas => (canvas.dataset.patience = 60000)")  # of a busy machine
    page.locator("#volume").scroll_into_view_if_needed()
    yield page
    page.close()
    assert not trouble


def look(page: Page, turn: int, tilt: int) -> None:
    for name, value in (("turn", turn), ("tilt", tilt)):
        page.locator(f"#{name}").fill(str(value))


def picture(page: Page) -> np.ndarray:
    """The picture at rest (rows, columns, 3) 0 to 1, once it is at full size, and the same twice."""
    canvas, last = page.locator("#space"), None
    canvas.scroll_into_view_if_needed()  # what is out of sight is not drawn
    page.wait_for_timeout(300)
    page.wait_for_function("() => document.querySelector('#space').width === document.querySelector('#space').clientWidth")
    while (now := canvas.evaluate("canvas => canvas.toDataURL()")) != last:
        page.wait_for_timeout(250)
        last = now
    content = base64.b64decode(now.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), float) / 255


def sampled(image: np.ndarray, places_mm: np.ndarray) -> np.ndarray:
    """The picture's colours at places (N, 2), right and up in mm from its middle."""
    rows, columns = image.shape[:2]
    per_mm = rows / 2 / (0.505 * np.sqrt(3) * SIDE_MM)
    column = (columns / 2 + places_mm[:, 0] * per_mm).astype(int)
    row = (rows / 2 - places_mm[:, 1] * per_mm).astype(int)
    return image[row, column]


def centres_mm() -> np.ndarray:
    return (np.arange(EDGE) + 0.5) / EDGE * SIDE_MM - SIDE_MM / 2


@pytest.mark.parametrize(("turn", "tilt", "axis"), [(0, 0, 1), (0, 90, 0), (90, 0, 2)])
def test_a_projection_is_the_maximum_of_the_volume(page, ball, turn, tilt, axis) -> None:
    """Along y, with x to the right; along z from above; along x, seen from +x, with y to the right."""
    look(page, (360 - turn) % 360, tilt)
    image = picture(page)[..., 0]
    across, up = np.meshgrid(centres_mm(), centres_mm(), indexing="xy")
    inner = (abs(across) < 5) & (abs(up) < 5)  # the box's edges are drawn over the rest
    white = float(page.locator("#white-value").inner_text().strip("≤≥ ").split()[0])
    expected = np.clip(ball.max(axis=axis) / white, 0, 1)
    places = np.stack([across[inner], up[inner]], -1)
    assert sampled(image, places) == pytest.approx(expected[inner], abs=0.1)  # half a pixel of the steepest edge


def test_a_surface_stands_where_the_volume_crosses_the_threshold(page) -> None:
    look(page, 0, 0)
    page.locator("#space-surface").check()
    for step in (140, 100):
        page.locator("#threshold").fill(str(step))
        value = float(page.locator("#threshold-value").inner_text().split()[0])
        radius_mm = 2 * RADIUS_MM * (1 - value)
        image = picture(page)
        middle = image[:, image.shape[1] // 2].max(axis=1)
        per_mm = image.shape[0] / 2 / (0.505 * np.sqrt(3) * SIDE_MM)
        lit = np.flatnonzero(middle > 0.1)
        inside = [row for row in lit if abs(row - image.shape[0] / 2) < 5.5 * per_mm]
        assert (max(inside) - min(inside)) / per_mm / 2 == pytest.approx(radius_mm, abs=0.15)


def test_centres_lie_where_the_gaussians_are(page) -> None:
    look(page, 0, 0)
    before = picture(page)
    page.locator("#centres").check()
    after = picture(page)
    changed = np.argwhere(np.abs(after - before).max(axis=2) > 0.2)
    per_mm = before.shape[0] / 2 / (0.505 * np.sqrt(3) * SIDE_MM)
    middle = np.array(before.shape[:2]) / 2
    marks_mm = np.round((changed - middle) / (-per_mm, per_mm)).astype(int)  # up and to the right
    assert {tuple(mark) for mark in marks_mm} == {(-5, -5), (5, 5)}


def test_keys_mouse_and_the_window_of_the_slices_change_the_picture(page) -> None:
    canvas = page.locator("#space")
    seen = [picture(page)]
    canvas.focus()
    page.keyboard.press("ArrowRight")
    assert page.locator("#turn").input_value() == "330" and page.locator("#turn-value").inner_text() == "330°"
    seen.append(picture(page))
    box = canvas.bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 150)
    page.mouse.down()
    page.mouse.move(box["x"] + 300, box["y"] + 180, steps=3)
    page.mouse.up()
    assert float(page.locator("#tilt").input_value()) > 20
    seen.append(picture(page))
    page.keyboard.press("+")
    assert page.locator("#space-zoom").input_value() == "1.3"
    page.locator("#white").fill("120")
    seen.append(picture(page))
    assert all(a.shape != b.shape or np.abs(a - b).max() > 0.1 for a, b in zip(seen, seen[1:], strict=False))
    canvas.focus()
    page.keyboard.press("Home")
    assert page.locator("#turn").input_value() == "325" and page.locator("#space-zoom").input_value() == "1"
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"


def test_one_finger_turns_and_leaves_the_page_to_scroll(browser, address) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True)
    page = context.new_page()
    page.goto(address)
    page.wait_for_selector("#space[data-drawn]")
    canvas = page.locator("#space")
    canvas.scroll_into_view_if_needed()
    assert canvas.evaluate("canvas => getComputedStyle(canvas).touchAction") == "pan-y"
    box = canvas.bounding_box()
    at = {"x": box["x"] + 100, "y": box["y"] + 100}
    session = context.new_cdp_session(page)
    session.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [at]})
    for step in (20, 60, 100):
        session.send("Input.dispatchTouchEvent", {"type": "touchMove", "touchPoints": [{**at, "x": at["x"] + step}]})
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    assert page.locator("#turn").input_value() != "325" and page.locator("#tilt").input_value() == "20"
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    context.close()


def test_without_webgl_the_page_is_that_of_the_slices(browser, address) -> None:
    without = launch(browser.browser_type, *WITHOUT_WEBGL)
    trouble: list[str] = []
    page = watched(without.new_page(), address, trouble)
    page.wait_for_timeout(500)
    assert not page.locator("#volume").is_visible() and not page.locator('a[href="#volume"]').is_visible()
    page.locator("#slider-axial").focus()
    page.keyboard.press("Home")
    assert f" 1 of {EDGE}" in page.locator("#place-axial").inner_text()
    assert not trouble
    without.close()
