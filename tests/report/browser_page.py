"""The page in a real browser: not a part of the test suite, because it needs one.

    apt-get install chromium
    make test-browser

PHYRADGS_CHROMIUM names the browser's program if it is not on the path; PHYRADGS_PICTURES a folder for screenshots.
"""

import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect
from report.browser import SOFTWARE, launched, watched

from phyradgs_cl.io import read_volume
from phyradgs_cl.report import write_report

WIDTHS = (1280, 390)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with launched(*SOFTWARE) as browser:
        yield browser


@pytest.fixture(scope="module")
def address(rt, files, tmp_path_factory) -> str:
    page = tmp_path_factory.mktemp("browser") / "page.html"
    write_report(files[1], page, lambda: rt)
    return page.as_uri()


@pytest.fixture(params=WIDTHS)
def page(request, browser, address) -> Iterator[Page]:
    """The page at a desktop's and a phone's width; anything that it complains of or asks for fails the test."""
    trouble: list[str] = []
    page = watched(browser.new_page(viewport={"width": request.param, "height": 800}), address, trouble)
    page.wait_for_selector("#space[data-drawn]")
    yield page
    page.close()
    assert not trouble


def place(page: Page, plane: str) -> str:
    return page.locator(f"#place-{plane}").inner_text()


def picture(page: Page, plane: str) -> str:
    """What is seen of a plane, once its slice is decoded."""
    page.wait_for_function("[...document.querySelectorAll('.sheet img')].every(image => image.complete)")
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => setTimeout(done)))")
    return page.locator(f"#plane-{plane} canvas").evaluate("canvas => canvas.toDataURL()")


def hover(page: Page, plane: str, right: float, up: float) -> None:
    """Moves the pointer to fractions of a picture's width and height."""
    box = page.locator(f"#plane-{plane} .picture").bounding_box()
    page.mouse.move(box["x"] + right * box["width"], box["y"] + (1 - up) * box["height"])


def reading(page: Page) -> str:
    return page.locator("#reading").inner_text()


def test_a_slider_moves_by_keys(page) -> None:
    slider = page.locator("#slider-axial")
    before = picture(page, "axial")
    slider.focus()
    page.keyboard.press("ArrowRight")
    assert "8 of 12" in place(page, "axial") and picture(page, "axial") != before
    assert slider.get_attribute("aria-valuetext") == place(page, "axial")
    page.keyboard.press("Home")
    assert " 1 of 12" in place(page, "axial")
    page.keyboard.press("End")
    assert "12 of 12" in place(page, "axial")
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"


def test_a_click_in_a_picture_moves_the_other_two(page) -> None:
    images = page.locator("#plane-axial .picture")
    images.scroll_into_view_if_needed()
    box = images.bounding_box()
    images.click(position={"x": box["width"] * 0.1, "y": box["height"] * 0.9})
    assert " 2 of 12" in place(page, "sagittal") and " 2 of 12" in place(page, "coronal")
    assert "7 of 12" in place(page, "axial")
    for line, side, percent in (("upwards", "left", 12.5), ("across", "top", 87.5)):
        found = page.locator(f"#plane-axial .{line}").evaluate(f"e => parseFloat(e.style.{side})")
        assert found == pytest.approx(percent)


def test_the_value_under_the_pointer_is_that_of_the_file(page, files) -> None:
    volume = read_volume(files[1]).values
    picture(page, "coronal")
    assert reading(page).startswith("Where the lines cross, x 0.08, y 0.08, z 0.08 mm: ")
    page.locator("#plane-coronal").scroll_into_view_if_needed()
    for right, up, column, row in ((0.375, 0.625, 4, 7), (0.54, 0.46, 6, 5)):
        hover(page, "coronal", right, up)
        match = re.fullmatch(r"Under the pointer, x (.*), y (.*), z (.*) mm: (.*) 1/mm", reading(page).replace("−", "-"))
        x, _, z, value = (float(number) for number in match.groups())
        assert (x, z) == pytest.approx(((column - 5.5) / 6, (row - 5.5) / 6), abs=6e-3)
        assert value == pytest.approx(volume[row, 6, column], abs=0.006)
    page.mouse.move(0, 0)
    assert reading(page).startswith("Where the lines cross")


def test_window_sliders_change_what_black_and_white_are(page) -> None:
    before = picture(page, "axial")
    page.locator("#white").focus()
    for _ in range(40):
        page.keyboard.press("ArrowLeft")
    after = picture(page, "axial")
    assert after != before and page.locator("#white").get_attribute("aria-valuetext").endswith("1/mm")
    page.locator("#layer-difference").check()
    assert page.locator("#black").is_disabled()
    ends = [page.locator(f"#{end}-value").inner_text().strip("≤≥ ") for end in ("black", "white")]
    assert ends[0] == f"−{ends[1]}"
    page.locator("#layer-result").check()
    assert picture(page, "axial") == after
    page.locator("#layer-truth").check()
    assert picture(page, "axial") != after
    page.locator("#layer-result").check()
    page.locator("#reset").click()
    assert picture(page, "axial") == before


def test_the_wheel_turns_slices_where_the_pointer_has_moved_and_zooms_with_ctrl(page) -> None:
    page.locator("#plane-axial").scroll_into_view_if_needed()
    hover(page, "axial", 0.5, 0.5)
    hover(page, "axial", 0.2, 0.2)
    page.mouse.wheel(0, -100)
    page.wait_for_function("document.querySelector('#place-axial').textContent.includes('8 of 12')")
    page.keyboard.down("Control")
    page.mouse.wheel(0, -100)
    page.keyboard.up("Control")
    page.wait_for_function("document.querySelector('#zoom').value === '1.5'")
    assert "8 of 12" in place(page, "axial")


def test_zoom_keeps_the_crossing_in_sight_and_the_bar_true(page) -> None:
    bar, box = page.locator("#plane-axial .bar"), page.locator("#plane-axial .picture")
    page.locator("#zoom").focus()
    page.keyboard.press("End")
    length_mm, share = float(bar.inner_text().split()[0]), bar.bounding_box()["width"] / box.bounding_box()["width"]
    assert share == pytest.approx(8 * length_mm / 2.0, rel=0.02)
    page.locator("#slider-sagittal").focus()
    page.keyboard.press("Home")
    line, seen = page.locator("#plane-axial .upwards").bounding_box(), box.bounding_box()
    assert seen["x"] <= line["x"] <= seen["x"] + seen["width"]


def test_nothing_is_wider_than_the_window_and_tab_reaches_every_control(page) -> None:
    assert page.evaluate("document.documentElement.scrollWidth") == page.viewport_size["width"]
    assert page.evaluate("[...document.images].every(i => i.complete && i.naturalWidth > 0)")
    reached = []
    for _ in range(40):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.id || document.activeElement.tagName"))
    sliders = {"slider-axial", "slider-coronal", "slider-sagittal", "black", "white", "zoom", "turn", "tilt", "space-zoom"}
    others = {"reset", "layer-result", "space", "space-maximum", "space-reset", "rows", "rows-play", "rows-time", "SUMMARY"}
    assert sliders | others <= set(reached)


def test_pictures_for_the_documentation(browser, address, tmp_path: Path) -> None:
    """The first screens and whole pages, at both widths, for a look."""
    folder = Path(os.environ.get("PHYRADGS_PICTURES") or tmp_path)
    folder.mkdir(parents=True, exist_ok=True)
    for width, height in ((1280, 800), (390, 844)):
        page = browser.new_page(viewport={"width": width, "height": height})
        page.goto(address)
        for name, whole in ((f"page_{width}.png", False), (f"whole_{width}.png", True)):
            page.screenshot(path=folder / name, full_page=whole)
            assert (folder / name).stat().st_size > 10_000
        page.close()


def test_the_frame_in_motion_plays_once_and_has_keys(page) -> None:
    """It plays when it is first seen, and ends with all lines read; the slider and the button go anywhere by keys."""
    canvas, time, play = page.locator("#rows"), page.locator("#rows-time"), page.locator("#rows-play")
    canvas.scroll_into_view_if_needed()
    expect(play).to_have_text("Pause")
    play.focus()
    page.keyboard.press("Enter")
    expect(play).to_have_text("Play")
    time.focus()
    page.keyboard.press("Home")
    expect(page.locator("#rows-reading")).to_contain_text("0 % read")
    before = canvas.evaluate("canvas => canvas.toDataURL()")
    page.keyboard.press("End")
    expect(page.locator("#rows-reading")).to_contain_text("0 % of the rows exposed, 100 % read")
    assert time.get_attribute("aria-valuetext") == page.locator("#rows-reading").inner_text().rstrip(".")
    after = canvas.evaluate("canvas => canvas.toDataURL()")
    canvas.focus()
    page.keyboard.press("ArrowLeft")
    assert before != after
    page.wait_for_function("(after) => document.querySelector('#rows').toDataURL() !== after", arg=after)


def test_nothing_moves_for_readers_who_want_no_motion(browser, address) -> None:
    page = browser.new_page(reduced_motion="reduce")
    page.goto(address)
    page.locator("#rows").scroll_into_view_if_needed()
    page.wait_for_timeout(500)
    assert page.locator("#rows-play").inner_text() == "Play" and page.locator("#rows-time").input_value() == "500"
    page.close()
