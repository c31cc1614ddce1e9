"""The browser of the tests that need one, and what is asked of every page in it."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Browser, BrowserType, Page, sync_playwright

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # WebGL2 on the processor
WITHOUT_WEBGL = ("--disable-3d-apis",)


@contextmanager
def launched(*arguments: str) -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = launch(playwright.chromium, *arguments)
        yield browser
        browser.close()


def launch(kind: BrowserType, *arguments: str) -> Browser:
    program = os.environ.get("PHYRADGS_CHROMIUM") or next(filter(None, map(shutil.which, PROGRAMS)), None)
    assert program, f"no browser: install one of {PROGRAMS}, or name its program by PHYRADGS_CHROMIUM"
    return kind.launch(executable_path=program, args=["--no-sandbox", *arguments])


def watched(page: Page, address: str, trouble: list[str]) -> Page:
    """Opens a page; errors, and what it asks of the world, are added to ``trouble``."""
    page.on("console", lambda message: message.type == "error" and trouble.append(message.text))
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.on("request", lambda asked: asked.url.startswith(("data:", address)) or trouble.append(asked.url))
    page.goto(address)
    return page
