"""The page of a run under way in a real browser: `make test-browser`."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect
from report.browser import launched, watched

from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors import Progress
from phyradgs_cl.report.live import Snapshot, Status, live_page

EVERY_S = 0.5
RAMP = np.linspace(0, 1, 512, dtype=np.float32).reshape(8, 8, 8)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with launched() as browser:
        yield browser


def write(path: Path, iteration: int, ago_s: float = 0.0, ended: str = "") -> None:
    """The page of a run at an iteration, written some time ago and replaced as a run replaces it."""
    now = time.time() - ago_s
    status = Status("volume.h5", {"scan": "scan.h5", "method": "sart", "options": {"relaxation": 0.7}}, EVERY_S, now - 60)
    for k in range(1, iteration + 1):
        status = status.after(Progress(k, 20, 1 / k, 0, 1.0, "residual"), now - 30 + k)
    snapshot = Snapshot.of(iteration, RAMP, Grid.cube(8, 4.0), [])
    text = live_page(Status(**{**vars(status), "snapshot": snapshot, "ended": ended}), now)
    path.with_suffix(".new").write_text(text, encoding="utf-8")
    path.with_suffix(".new").replace(path)


@pytest.fixture
def file(tmp_path) -> Path:
    write(tmp_path / "run.html", 3)
    return tmp_path / "run.html"


@pytest.fixture
def page(browser, file) -> Iterator[Page]:
    trouble: list[str] = []
    page = watched(browser.new_page(viewport={"width": 390, "height": 844}), file.as_uri(), trouble)
    yield page
    page.close()
    assert not trouble


def test_the_page_follows_the_run_and_keeps_the_place_of_the_keyboard(page, file) -> None:
    page.locator('nav a[href="#settings"]').focus()
    assert "3 of 20" in page.locator(".tiles").inner_text()
    write(file, 7)
    expect(page.locator(".tiles")).to_contain_text("7 of 20")
    assert page.evaluate("document.activeElement.getAttribute('href')") == "#settings"
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    page.evaluate("scrollTo(0, 600)")
    write(file, 8)
    expect(page.locator(".tiles")).to_contain_text("8 of 20")
    assert page.evaluate("scrollY") == 600


def test_it_pauses_and_goes_on_by_keys(page, file) -> None:
    reached = []
    for _ in range(8):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.id || document.activeElement.getAttribute('href')"))
        if reached[-1] == "pause":
            break
    assert reached[-1] == "pause"
    page.keyboard.press("Enter")
    write(file, 9)
    page.wait_for_timeout(3000 * EVERY_S)
    assert "3 of 20" in page.locator(".tiles").inner_text()
    assert page.locator("#pause").get_attribute("aria-pressed") == "true"
    page.keyboard.press("Enter")
    expect(page.locator(".tiles")).to_contain_text("9 of 20")


def test_a_page_without_news_says_so_until_there_are_some(page, file) -> None:
    write(file, 4, ago_s=100.0)
    expect(page.locator("#news")).to_contain_text("No news since ")
    assert page.title().startswith("no news")
    write(file, 5)
    expect(page.locator(".tiles")).to_contain_text("5 of 20")
    assert not page.locator("#news").is_visible()


def test_the_page_of_a_run_that_has_ended_stays(page, file) -> None:
    write(file, 6, ended="Interrupted at iteration 6 of 20.")
    expect(page.locator("#news")).to_contain_text("Interrupted at")
    assert page.locator("#pause").count() == 0
    page.evaluate("window.same = true")
    page.wait_for_timeout(3000 * EVERY_S)
    assert page.evaluate("window.same")
