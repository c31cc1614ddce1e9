"""The page of a run under way: what it shows, what it costs, and what it says at the end of a run."""

import time

import numpy as np
import pytest

from phyradgs_cl.errors import InputError, OutOfMemoryError, OutputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors import Progress
from phyradgs_cl.reconstructors.projected import FramePair
from phyradgs_cl.report import LivePage
from phyradgs_cl.report.live import SHARE, Snapshot, Status, live_page

pytestmark = pytest.mark.slow

GRID = Grid.cube(6, 3.0)
SETTINGS = {"scan": "scan.h5", "method": "sart", "options": {"relaxation": 0.7}}
HOSTILE = "</title><script>alert(1)</script>"


def volume(value: float = 1.0) -> tuple[np.ndarray, Grid]:
    values = np.zeros(GRID.shape, np.float32)
    values[3, 2, 4] = value
    return values, GRID


def pair(frame: int) -> FramePair:
    ones = np.ones((4, 5), np.float32)
    return FramePair(frame, ones, 0.75 * ones, ones > 0)


def report(iteration: int, loss: float = 0.5, **more: object) -> Progress:
    return Progress(iteration, 20, loss, 0, 1.0, "residual", volume=volume, **more)


def status(*reports: Progress, every_s: float = 2.0) -> Status:
    """A status after reports that came a second after each other from the tenth second on."""
    now = Status("volume.h5", SETTINGS, 5.0, 0.0)
    for second, one in enumerate(reports):
        now = now.after(one, 10.0 + second * every_s)
    return now


def test_the_page_has_the_numbers_of_the_run(parse) -> None:
    page = parse(live_page(status(report(4, 0.5), report(8, 0.25), report(12, 0.2)), 15.0))
    assert not page.open and len(page.ids) == len(set(page.ids))
    tiles = dict(zip(page.texts["span"], [text for text in page.texts["b"] if text], strict=False))
    assert tiles == {
        "iteration": "12 of 20", "residual": "0.2", "per minute": "120", "time left": "0:03", "time so far": "0:15",
    }  # fmt: skip
    assert "Residual: from 0.5 to 0.2 at iteration 12." in page.words and "relaxation" in page.words and "0.7" in page.words
    for link in page.all("a"):
        assert link["href"][1:] in page.ids
    assert [meta["content"] for meta in page.all("meta") if meta.get("http-equiv") == "refresh"] == ["5"]
    assert page.all("progress")[0]["value"] == "12"


def test_a_count_that_starts_again_is_another_curve() -> None:
    now = status(report(4), report(8), report(2))
    assert now.points == ((2, 0.5),) and now.per_s is None
    many = status(*(report(k % 20 or 20, 1.0) for k in range(1, 21)))
    for k in range(2000):
        many = many.after(Progress(20 + k, 4000, 0.5, 0, 1.0, "residual"), 60.0 + k)
    assert len(many.points) <= 401 and many.points[-1] == (2019, 0.5)
    assert many.progress.volume is None  # nothing of the run is held by its page


def test_pictures_are_those_of_the_volume_and_the_frames(parse) -> None:
    values, grid = volume(2.0)
    values[0, 0, 0] = 1.0
    snapshot, now = Snapshot.of(8, values, grid, [pair(3)]), status(report(4), report(8))
    page = parse(live_page(Status(**{**vars(now), "snapshot": snapshot}), 15.0))
    assert "after iteration 8" in page.words and "residual, RMS 0.25 (25 %)" in page.words
    axial, coronal, sagittal = (page.pixels(image["src"]) for image in page.all("img")[:3])
    assert axial[6 - 1 - 2, 4] == 255 and axial.astype(int).sum() == 255
    assert coronal.max() == sagittal.max() == 0  # y = 3 and x = 3 hold nothing


def test_a_hostile_name_is_text(parse) -> None:
    page = parse(live_page(Status(HOSTILE, {"scan": HOSTILE, HOSTILE: HOSTILE}, 5.0, 0.0, ended=HOSTILE), 1.0))
    assert not page.open and len(page.all("script")) == 2 and len(page.all("title")) == 1


def test_pictures_wait_until_they_cost_less_than_their_share(tmp_path) -> None:
    """A volume that takes 20 ms to get comes at the first report, and then once in 2 s and more."""
    taken = []

    def slow() -> tuple[np.ndarray, Grid]:
        taken.append(time.monotonic())
        time.sleep(0.02)
        return volume()

    live, started_s = LivePage(tmp_path / "p.html", "v.h5", SETTINGS, every_s=0.0), time.monotonic()
    while (used_s := time.monotonic() - started_s) < 0.3:
        live(Progress(1, 9, 0.5, 0, 1.0, volume=slow))
    assert len(taken) == 1 and live.spent_s >= 0.02
    live._started_s -= 100 * live.spent_s  # as if so much time had passed
    live(Progress(2, 9, 0.5, 0, 1.0, volume=slow))
    assert len(taken) == 2 and used_s > 0 and SHARE <= 0.01


def test_a_thread_keeps_the_page_fresh_and_ends_with_the_run(tmp_path) -> None:
    path = tmp_path / "p.html"
    with LivePage(path, "v.h5", SETTINGS, every_s=0.02) as live:
        first = path.read_text(encoding="utf-8")
        live.stage("building kernels")
        deadline = time.monotonic() + 10
        while "Building kernels." not in path.read_text(encoding="utf-8") and time.monotonic() < deadline:
            time.sleep(0.01)
        assert "Building kernels." in path.read_text(encoding="utf-8") and "starting – v.h5" in first
        live(report(3))
    last = path.read_text(encoding="utf-8")
    assert "The run is complete." in last and "complete – v.h5" in last and 'class="warning"' not in last
    assert '"is_over":true' in last and 'http-equiv="refresh"' not in last
    assert not live._writer.is_alive() and [one.name for one in tmp_path.iterdir()] == ["p.html"]


def test_frames_are_left_out_where_the_device_has_no_room_for_them(tmp_path, caplog) -> None:
    def full(count: int) -> list[FramePair]:
        raise OutOfMemoryError("device memory", "1 GiB", "2 GiB")

    live = LivePage(tmp_path / "p.html", "v.h5", SETTINGS, every_s=0.0)
    live._started_s -= 100.0  # a long run
    for k in range(2):
        live(report(1 + k, frames=full))
    assert live.status.snapshot.frames == [] and caplog.text.count("no frames on the live page") == 1
    live(report(3, frames=lambda count: [pair(k) for k in range(count)]))
    assert [one.frame for one in live.status.snapshot.frames] == [0, 1]


def test_a_page_that_cannot_be_written_is_one_warning(tmp_path, monkeypatch, caplog) -> None:
    def full(*arguments: object) -> None:
        raise OutputError("p.html", "no room left")

    monkeypatch.setattr("phyradgs_cl.report.live.written_beside", full)
    with LivePage(tmp_path / "p.html", "v.h5", SETTINGS, every_s=0.01):
        time.sleep(0.1)
    assert caplog.text.count("no live page") == 1


def test_a_report_that_fails_says_how_to_make_it(tmp_path, caplog) -> None:
    def fail(path: object) -> None:
        raise InputError("volume.h5", "nothing", "a volume")

    with LivePage(tmp_path / "p.html", "v.h5", SETTINGS) as live:
        live.become(fail)
    assert "'phyradgs report' makes its report" in (tmp_path / "p.html").read_text(encoding="utf-8").replace("&#x27;", "'")
    with LivePage(tmp_path / "p.html", "v.h5", SETTINGS) as live:
        live.become(lambda path: path.write_text("the report", encoding="utf-8"))
    assert (tmp_path / "p.html").read_text(encoding="utf-8") == "the report"
