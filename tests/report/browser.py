"""The browser of the tests that need one, and what is asked of every page in it."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Browser, BrowserType, Page, sync_playwright

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # WebGL2 on the processor
WITHOUT_WEBGL = ("--disable-3d-apis",)
# The text elements whose colours differ by less than 4.5 to 1 (3 to 1 for large letters), as WCAG 2 counts it.
POOR_CONTRAST = """() => {
  const parse = (text) => (text.match(/[\\d.]+/g) || [0, 0, 0, 0]).map(Number);
  const channel = (value) => (value /= 255) <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * channel(r) + 0.7152 * channel(g) + 0.0722 * channel(b);
  const ground = (element) => {
    for (let at = element; at; at = at.parentElement) {
      const colour = parse(getComputedStyle(at).backgroundColor);
      if (colour.length === 3 || colour[3] === 1) return colour;
    }
    return [255, 255, 255];
  };
  const poor = [];
  for (const element of document.querySelectorAll("body *:not(script):not(svg *)")) {
    if (![...element.childNodes].some((node) => node.nodeType === 3 && node.data.trim()) || !element.offsetParent) continue;
    if (element.matches(":disabled, .picture *")) continue; // on pictures there is a shadow behind white letters
    const style = getComputedStyle(element);
    const pair = [light(parse(style.color)), light(ground(element))].sort((a, b) => b - a);
    const ratio = (pair[0] + 0.05) / (pair[1] + 0.05), isLarge = parseFloat(style.fontSize) >= 24;
    if (ratio < (isLarge ? 3 : 4.5)) poor.push([element.tagName, element.textContent.slice(0, 40), ratio]);
  }
  return poor;
}"""


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
