"""Takes pictures of the report and of the live page in a real browser, for docs/gallery.md and docs/report.md.

    python docs/browser_pictures.py [FOLDER]

Needs playwright (pip install playwright) and Chromium or Chrome. FOLDER takes the scan, the volume and the pages (default: a
temporary folder). A scan and a volume that exist there are used again. docs/gallery.py puts ``SECTION`` at the end of its
page."""

import io
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image

IMAGES = Path(__file__).resolve().parent / "images" / "gallery"
PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # WebGL2 without a GPU
DESKTOP, PHONE = {"width": 1000, "height": 700}, {"width": 390, "height": 760}
COLOURS = 160  # colours of a picture
SHOWN_FROM = 300  # iteration of the live page from which on pictures are taken
GAP = 12  # pixels between pictures
SIMULATE = "simulate --phantom foot --size 64 --detector 96 --noise tigre -o scan.h5"
RECONSTRUCT = "reconstruct scan.h5 --method phyradgs --iterations 600 -o volume.h5"
BREATHING = 'kind = "breathing"\nperiod_s = 4.0\n'
SIMULATE_MOVING = (
    "simulate --phantom foot --size 40 --detector 60 --views 60 --turns 3 --fps 6 --exposure-deg 4 "
    "--motion-of-object breathing.toml -o moving.h5"
)
RECONSTRUCT_MOVING = "reconstruct moving.h5 --object-motion moving.h5 --method fdk -o reference.h5"
SECTION = f"""## The report and the live page in a browser

A run of the paper's method: its live page, and the report that this page becomes (`python docs/browser_pictures.py`).

```sh
phyradgs {SIMULATE}
phyradgs {RECONSTRUCT} --live run.html
```

The volume in 3D as a surface; as a maximum with the Gaussians' centres, on a phone; the first projection in motion.

![The volume in 3D](images/gallery/report_space.png)

![Centres of Gaussians and the first projection on a phone](images/gallery/report_phone.png)

A browser without WebGL2 shows the slices.

![Without WebGL2](images/gallery/report_without_webgl.png)

An object that breathes: arrows from where matter is in the reference volume, twice as long.

```sh
phyradgs {SIMULATE_MOVING}
phyradgs {RECONSTRUCT_MOVING}
```

![An object that moves](images/gallery/report_motion.png)

The live page of the run; on a phone; and after a kill.

![The live page](images/gallery/live_desktop.png)

![The live page on a phone, and after a kill](images/gallery/live_phone.png)
"""


def main() -> None:
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as temporary, sync_playwright() as playwright:
        folder = Path(sys.argv[1] if sys.argv[1:] else temporary).resolve()
        program = os.environ.get("PHYRADGS_CHROMIUM") or next(filter(None, map(shutil.which, PROGRAMS)))

        def launch(*arguments: str) -> Any:
            return playwright.chromium.launch(executable_path=program, args=["--no-sandbox", *arguments])

        if not (folder / "scan.h5").exists():
            start(SIMULATE, folder).wait()
        browser = launch()
        take_live(browser, folder)
        browser.close()
        if not (folder / "volume.h5").exists():
            start(RECONSTRUCT, folder).wait()
        start("report volume.h5 -o report.html", folder).wait()
        for arguments in (SOFTWARE, ["--disable-3d-apis"]):
            browser = launch(*arguments)
            take_report(browser, folder / "report.html", has_webgl=arguments is SOFTWARE)
            if arguments is SOFTWARE:
                take_motion(browser, folder)
            browser.close()


def start(words: str, folder: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", "phyradgs_cl", *words.split()], cwd=folder)


def take_live(browser: Any, folder: Path) -> None:
    """Takes the pictures of a run under way, then kills it and waits until the page says so."""
    page_file = folder / "run.html"
    page_file.unlink(missing_ok=True)
    run = start(f"{RECONSTRUCT.replace('600', '2000').replace('volume', 'killed')} --live run.html", folder)
    try:
        while not (page_file.exists() and shown_iteration(page_file) >= SHOWN_FROM):
            time.sleep(1)
            if run.poll() is not None:
                sys.exit("the run has ended before its page had pictures")
        desktop, phone = opened(browser, page_file, DESKTOP), opened(browser, page_file, PHONE, "dark")
        for page in (desktop, phone):
            page.locator("#pause").click()  # a page that reloads itself cannot be photographed
        under_way = phone.screenshot()
        save("live_desktop", desktop.screenshot(clip={"x": 0, "y": 0, "width": 1000, "height": 1500}, full_page=True))
    finally:
        run.send_signal(signal.SIGKILL)
        run.wait()
    phone.locator("#news.warning").wait_for(timeout=120_000)
    save("live_phone", under_way, phone.screenshot())


def shown_iteration(page_file: Path) -> int:
    """Returns the finished iterations on a live page that has projections, otherwise 0."""
    text = page_file.read_text(encoding="utf-8")
    value = re.search(r'<progress value="(\d+)"', text)
    return int(value[1]) if value and 'id="projections"' in text else 0


def take_report(browser: Any, page_file: Path, *, has_webgl: bool) -> None:
    desktop = opened(browser, page_file, DESKTOP)
    if not has_webgl:
        save("report_without_webgl", desktop.screenshot(clip={"x": 0, "y": 0, "width": 1000, "height": 900}, full_page=True))
        return
    for name, width, height in (("../report_desktop", 1280, 1330), ("../report_phone", 390, 1250)):  # for docs/report.md
        page = opened(browser, page_file, {"width": width, "height": 800})
        save(name, page.screenshot(clip={"x": 0, "y": 0, "width": width, "height": height}, full_page=True))
    at_rest(desktop, "space-surface")
    save("report_space", desktop.locator("#volume").screenshot())
    phone = opened(browser, page_file, PHONE, "dark")
    at_rest(phone, "centres")
    space = phone.locator("#volume").screenshot()
    phone.locator("#rows-time").fill("330")
    save("report_phone", space, phone.locator("#shutter .scripted-only").screenshot())


def take_motion(browser: Any, folder: Path) -> None:
    """Takes the picture of an object that moves, in the middle of a breath."""
    (folder / "breathing.toml").write_text(BREATHING)
    if not (folder / "reference.h5").exists():
        start(SIMULATE_MOVING, folder).wait()
        start(RECONSTRUCT_MOVING, folder).wait()
    start("report reference.h5 -o motion.html --views 0", folder).wait()
    page = opened(browser, folder / "motion.html", DESKTOP)
    page.locator("#motion-time").fill("40")
    page.locator("#motion-arrows").fill("2")
    page.locator("#motion").scroll_into_view_if_needed()
    page.wait_for_timeout(3000)
    save("report_motion", page.locator("#motion").screenshot())


def opened(browser: Any, page_file: Path, size: dict[str, int], scheme: str = "light") -> Any:
    page = browser.new_page(viewport=size, color_scheme=scheme, reduced_motion="reduce")
    page.goto(page_file.as_uri())
    page.wait_for_timeout(1000)
    return page


def at_rest(page: Any, control: str) -> None:
    """Uses a control of the 3D view, and waits until the picture is drawn in full."""
    page.wait_for_selector("#space[data-drawn]")
    page.locator("#space").evaluate("canvas => (canvas.dataset.patience = 60000)")
    page.locator(f"#{control}").check()
    page.locator("#volume").scroll_into_view_if_needed()
    page.wait_for_timeout(3000)
    page.wait_for_function("() => document.querySelector('#space').width >= document.querySelector('#space').clientWidth")
    page.wait_for_timeout(1000)


def save(name: str, *shots: bytes) -> None:
    """Writes screenshots side by side, as a PNG of few colours."""
    pictures = [Image.open(io.BytesIO(shot)).convert("RGB") for shot in shots]
    width = sum(one.width + GAP for one in pictures) - GAP
    sheet = Image.new("RGB", (width, max(one.height for one in pictures)), "white")
    left = 0
    for one in pictures:
        sheet.paste(one, (left, 0))
        left += one.width + GAP
    IMAGES.mkdir(parents=True, exist_ok=True)
    sheet.quantize(COLOURS).save(IMAGES / f"{name}.png", optimize=True)
    print(f"{name}: {(IMAGES / name).with_suffix('.png').stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
