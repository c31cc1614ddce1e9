"""The volume in 3D in a real browser, whose WebGL2 may run on the processor: `make test-browser`."""

import base64
import io
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, expect
from report.browser import SOFTWARE, WITHOUT_WEBGL, launch, launched, watched
from scipy.ndimage import map_coordinates

from phyradgs_cl.fields import Deformation, Gaussians, Grid
from phyradgs_cl.fields.deformation import control_points
from phyradgs_cl.io import sha256_of, write_deformation, write_volume
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
    expected, places = np.clip(ball.max(axis=axis) / white, 0, 1), np.stack([across[inner], up[inner]], -1)
    assert sampled(image, places) == pytest.approx(expected[inner], abs=0.1)  # half a pixel of the steepest edge


def test_a_surface_stands_where_the_volume_crosses_the_threshold(page) -> None:
    look(page, 0, 0)
    page.locator("#space-surface").check()
    for step in (140, 100):
        page.locator("#threshold").fill(str(step))
        value = float(page.locator("#threshold-value").inner_text().split()[0])
        radius_mm, image = 2 * RADIUS_MM * (1 - value), picture(page)
        middle = image[:, image.shape[1] // 2].max(axis=1)
        per_mm, lit = image.shape[0] / 2 / (0.505 * np.sqrt(3) * SIDE_MM), np.flatnonzero(middle > 0.1)
        inside = [row for row in lit if abs(row - image.shape[0] / 2) < 5.5 * per_mm]
        assert (max(inside) - min(inside)) / per_mm / 2 == pytest.approx(radius_mm, abs=0.15)


def test_centres_lie_where_the_gaussians_are(page) -> None:
    look(page, 0, 0)
    before = picture(page)
    page.locator("#centres").check()
    after = picture(page)
    changed = np.argwhere(np.abs(after - before).max(axis=2) > 0.2)
    per_mm, middle = before.shape[0] / 2 / (0.505 * np.sqrt(3) * SIDE_MM), np.array(before.shape[:2]) / 2
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


@pytest.fixture(scope="module")
def field() -> Deformation:
    """All matter goes to +x and −z by up to two voxels, and turns a little."""
    origin_mm, counts = control_points(Grid.cube(EDGE, SIDE_MM), 4.0)
    random = np.random.default_rng(3).normal(0, 0.15, (1, *counts, 3)) + [-1.0, 0.0, 0.8]
    return Deformation(random, origin_mm, 4.0, np.array([0.0, 4.0]), np.array([[0.3], [1.0]]))


@pytest.fixture(scope="module")
def moving(ball, field, tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("moving")
    write_deformation(folder / "field.h5", field)
    facts = {"object_motion": "field.h5", "object_motion_sha256": sha256_of(folder / "field.h5")}
    write_volume(folder / "ball.h5", ball, Grid.cube(EDGE, SIDE_MM), facts)
    write_report(folder / "ball.h5", folder / "page.html", lambda: None)
    return (folder / "page.html").as_uri()


def state(page: Page, axis: str) -> np.ndarray:
    """A slice of the moving object as the page draws it (rows from below, columns), 0 to 255."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => setTimeout(done, 50)))")
    text = page.locator(f"#motion-{axis} canvas").first.evaluate("canvas => canvas.toDataURL()")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(text.partition(",")[2]))).convert("L"), float)[::-1]


def test_any_time_of_a_moving_object_is_drawn(browser, moving, ball, field) -> None:
    """By keys alone: the time, the slices, the length of the arrows."""
    trouble: list[str] = []
    page = watched(browser.new_page(viewport={"width": 900, "height": 700}), moving, trouble)
    expect(page.locator("#motion-arrows-value")).to_have_text("1×")
    grid, high = Grid.cube(EDGE, SIDE_MM), float(np.percentile(ball, 99.9))
    for presses, time_s in ((0, 0.0), (50, 1.0), (150, 4.0)):
        page.locator("#motion-time").focus()
        for _ in range(presses):
            page.keyboard.press("ArrowRight")
        expect(page.locator("#motion-time-value")).to_have_text(f"{time_s:.2f} s")
        shift = field.on_grid_mm(grid, field.weights_at(time_s)[0])[..., ::-1] / np.array(grid.voxel_size_mm)
        places = np.indices(grid.shape) + np.moveaxis(shift, -1, 0)
        expected = 255 * np.clip(map_coordinates(ball, places, order=1, mode="grid-constant") / high, 0, 1)
        for axis, middle in (("z", expected[12]), ("y", expected[:, 12]), ("x", expected[:, :, 12])):
            assert np.abs(state(page, axis) - middle).max() <= 3, (time_s, axis)  # steps of 8 bit, here 1.2 of the picture's
    page.locator("#motion-slice-z").focus()
    page.keyboard.press("ArrowLeft")
    assert np.abs(state(page, "z") - expected[11]).max() <= 3
    overlay = page.locator("#motion-z canvas").nth(1)
    inked = "a => a.getContext('2d').getImageData(0, 0, a.width, a.height).data.filter((value) => value > 99).length"
    with_arrows = overlay.evaluate(inked)
    page.locator("#motion-arrows").focus()
    page.keyboard.press("Home")
    expect(page.locator("#motion-arrows-value")).to_have_text("none")
    assert overlay.evaluate(inked) == 0 < with_arrows
    page.locator("#motion-play").focus()
    page.keyboard.press("Enter")
    page.wait_for_function("() => document.querySelector('#motion-time').valueAsNumber < 180")
    page.locator("#motion-reset").click()
    assert page.locator("#motion-time").input_value() == "0" and page.locator("#motion-play").inner_text() == "Play"
    page.close()
    assert not trouble


def test_a_page_without_scripts_or_webgl_shows_the_moving_object(browser, moving) -> None:
    plain = browser.new_context(java_script_enabled=False).new_page()
    plain.goto(moving)
    assert plain.locator("#motion-z img").is_visible() and not plain.locator("#motion-time").is_visible()
    assert plain.locator("#motion-reading").inner_text() == "The object at 0 s, the first of 4 s."
    plain.close()
    other = launch(browser.browser_type, *WITHOUT_WEBGL)
    page = other.new_page()
    page.goto(moving)
    expect(page.locator("#motion-arrows-value")).to_have_text("1×")
    assert state(page, "z").max() > 100 and not page.locator("#volume").is_visible()
    other.close()
