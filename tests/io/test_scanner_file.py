"""Scanner files: the three that come with the project, and messages about others."""

from pathlib import Path

import pytest

from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, pixel_centres
from phyradgs_cl.acquisition.geometry import default_grid
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import load_scanner, with_detector_count
from phyradgs_cl.simulation import scanner_options

pytestmark = pytest.mark.slow

DATA = Path(__file__).parents[2] / "data"
GOOD = """
[source]
to_axis_mm = 500
to_detector_mm = 1000.0
[detector]
rows = 40
columns = 60
pixel_size_v_mm = 2.0
pixel_size_u_mm = 1.0
offset_u_mm = 3.5
[volume]
shape = [10, 20, 40]
size_mm = [10.0, 20.0, 80.0]
offset_mm = [1.0, 2.0, 3.0]
[readout]
axis = "columns"
direction = -1
ratio = 0.5
"""


@pytest.fixture
def write(tmp_path):
    def written(text: str) -> Path:
        (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
        return tmp_path / "mine.toml"

    return written


def test_the_scanners_that_come_with_the_project() -> None:
    """The benchmark's; and a C-arm that sees its volume in every view."""
    r2, arm = load_scanner("r2", DATA), load_scanner("carm", DATA)
    assert (r2.geometry.source_to_axis_mm, r2.geometry.source_to_detector_mm) == (5, 7)
    assert r2.geometry.detector_shape == (512, 512) and r2.geometry.pixel_size_mm == (4 / 512, 4 / 512)
    assert r2.grid.shape == (256,) * 3 and r2.grid.size_mm == (2, 2, 2)
    assert (arm.geometry.source_to_axis_mm, arm.geometry.source_to_detector_mm) == (785, 1200)
    assert arm.grid.size_mm == pytest.approx((200, 200, 200))
    assert min(default_grid(arm.geometry).size_mm) > 200  # the inscribed cylinder
    beamline = load_scanner("parallel", DATA)
    assert beamline.geometry == ParallelGeometry((512, 512), 0.005)
    assert beamline.grid.size_mm[1] * 2**0.5 < 512 * 0.005


def test_all_fields(write) -> None:
    """Editors of Windows write a byte order mark; volume and readout may be left out."""
    for text in (GOOD, "\ufeff" + GOOD):
        scanner = load_scanner(write(text), DATA)
        assert scanner.geometry == ConeGeometry(500.0, 1000.0, (40, 60), (2.0, 1.0), (0.0, 3.5))
        assert scanner.grid == Grid((10, 20, 40), (1.0, 1.0, 2.0), (1.0, 2.0, 3.0))
        assert (scanner.readout_axis, scanner.readout_direction, scanner.readout_ratio) == (
            "columns", -1, 0.5,
        )
    scanner = load_scanner(write(GOOD.split("[volume]")[0]), DATA)
    assert scanner.grid == default_grid(scanner.geometry)
    assert (scanner.readout_axis, scanner.readout_direction, scanner.readout_ratio) == ("rows", 1, None)


def test_a_parallel_beam_has_no_distance(write) -> None:
    distances, parallel = "to_axis_mm = 500\nto_detector_mm = 1000.0", 'beam = "parallel"'
    scanner = load_scanner(write(GOOD.replace(distances, parallel)), DATA)
    assert scanner.geometry == ParallelGeometry((40, 60), (2.0, 1.0), (0.0, 3.5))
    assert load_scanner(write(GOOD.replace("[source]", '[source]\nbeam = "cone"')), DATA).geometry.source_to_axis_mm == 500
    both = r"\[source\] to_axis_mm: found 500; expected no distance: beam is 'parallel'"
    for text, words in ((f"{parallel}\n{distances}", both), ('beam = "fan"', r"\[source\] beam: found 'fan'")):
        with pytest.raises(InputError, match=words):
            load_scanner(write(GOOD.replace(distances, text)), DATA)


def test_pulse_and_lag_of_a_scanner(write) -> None:
    plain = load_scanner(write(GOOD), DATA)
    assert plain.pulse is None and plain.lag == 0
    panel = GOOD.replace("columns = 60", "columns = 60\nlag = 0.03")
    scanner = load_scanner(write(panel + "[beam]\npulse_start = 0.5\npulse_length = 0.25\n"), DATA)
    assert scanner.pulse == (0.5, 0.25) and scanner.lag == 0.03
    for line, key in (("pulse_start = 0.5", "pulse_length"), ("pulse_start = 0\npulse_length = 0", "length")):
        with pytest.raises(InputError, match=rf"\[beam\] .*{key}"):
            load_scanner(write(f"{GOOD}[beam]\n{line}\n"), DATA)
    with pytest.raises(InputError, match=r"\[detector\] lag"):
        load_scanner(write(GOOD.replace("columns = 60", "columns = 60\nlag = 1.0")), DATA)


WRONG = {
    "unknown key": ("rows = 40", "rows = 40\ncolums = 60", "[detector] colums", "did you mean 'columns'"),
    "unknown table": ("[volume]", "[volumes]", "volumes", "did you mean 'volume'"),
    "missing key": ("to_axis_mm = 500", "", "[source] to_axis_mm", "nothing"),
    "text for a number": ("to_axis_mm = 500", 'to_axis_mm = "500"', "[source] to_axis_mm", "'500'"),
    "negative": ("pixel_size_v_mm = 2.0", "pixel_size_v_mm = -2.0", "[detector] pixel_size_v_mm", "above 0"),
    "infinite": ("pixel_size_v_mm = 2.0", "pixel_size_v_mm = inf", "[detector] pixel_size_v_mm", "finite"),
    "not a number": ("offset_u_mm = 3.5", "offset_u_mm = nan", "[detector] offset_u_mm", "finite"),
    "boundless": ("rows = 40", "rows = 1" + "0" * 400, "[detector] rows", "finite"),
    "half a row": ("rows = 40", "rows = 40.5", "[detector] rows", "whole"),
    "true": ("rows = 40", "rows = true", "[detector] rows", "True"),
    "detector before axis": (
        "to_detector_mm = 1000.0", "to_detector_mm = 400", "[source] to_detector_mm", "500",
    ),
    "two counts": ("shape = [10, 20, 40]", "shape = [10, 20]", "[volume] shape", "three"),
    "no list": ("shape = [10, 20, 40]", "shape = 10", "[volume] shape", "three"),
    "zero voxels": ("shape = [10, 20, 40]", "shape = [10, 0, 40]", "[volume] shape", "at least 1"),
    "flat volume": ("[10.0, 20.0, 80.0]", "[10.0, 0, 80.0]", "[volume] size_mm", "above 0"),
    "axis": ('axis = "columns"', 'axis = "cols"', "[readout] axis", "'rows'"),
    "direction": ("direction = -1", "direction = 0", "[readout] direction", "-1"),
    "direction in words": (
        "direction = -1", 'direction = "top"', "[readout] direction: found 'top'", "expected 1 (index 0 first) or -1",
    ),
    "direction true": ("direction = -1", "direction = true", "[readout] direction", "True"),
    "ratio": ("ratio = 0.5", "ratio = -0.5", "[readout] ratio", "at least 0"),
    "not TOML": ("[source]", "[source", "", "not TOML"),
    "table as a number": ("[readout]", "[[readout]]", "[readout]", "a table"),
}


def test_errors_name_table_and_key(write, tmp_path) -> None:
    for old, new, where, word in WRONG.values():
        assert old in GOOD
        path = write(GOOD.replace(old, new, 1))
        with pytest.raises(InputError) as caught:
            load_scanner(path, DATA)
        text = str(caught.value)
        assert text.startswith(f"{path} {where}".strip()) and word in text and "\n" not in text, text
    for name, words in (("carmm", r"did you mean 'carm'"), (tmp_path / "none.toml", "no such file")):
        with pytest.raises(InputError, match=words):
            load_scanner(name, DATA)


def test_another_count_keeps_the_panel() -> None:
    geometry = ConeGeometry(500.0, 1000.0, (40, 60), (2.0, 1.0), (1.0, 3.5))
    coarse = with_detector_count(geometry, 10, 15)
    # 4 × 4 pixels become one, centred among them
    fine_mm = pixel_centres(geometry.pose(0.3), geometry.detector_shape).reshape(10, 4, 15, 4, 3)
    coarse_mm = pixel_centres(coarse.pose(0.3), coarse.detector_shape)
    assert coarse_mm == pytest.approx(fine_mm.mean((1, 3)), abs=1e-9)
    with pytest.raises(InputError):
        with_detector_count(geometry, 0, 5)


def test_a_data_sheet_s_words(write) -> None:
    """In place of axis, direction and ratio; a readout in ms needs a rate where nothing else states a frame's time."""
    plain = GOOD.split("[readout]")[0]
    scanner = load_scanner(write(f'{plain}[readout]\nfirst = "top"\nfps = 15\nreadout_ms = 62\n'), DATA)
    assert (scanner.readout_axis, scanner.readout_direction, scanner.fps, scanner.readout_ms) == ("rows", -1, 15, 62)
    protocol = scanner_options(scanner, "rapid").protocol
    assert (protocol.exposure_s, protocol.readout_ratio) == pytest.approx((1 / 15, 0.93))
    assert scanner_options(scanner, "rapid", readout_ratio=0.5).protocol.readout_ratio == 0.5
    slow = load_scanner(write(f"{plain}[readout]\nreadout_ms = 62\n"), DATA)
    with pytest.raises(InputError, match=r"^mine \[readout\] readout_ms: found 62 without a frame rate"):
        scanner_options(slow, "rapid")
    for lines, words in {
        'first = "top"\naxis = "columns"': r"\[readout\] first: found 'top' with axis 'columns'; expected 'rows'",
        "readout_ms = 62\nratio = 0.5": r"\[readout\] readout_ms: found 62 with ratio",
        "fps = 0": r"\[readout\] fps: found 0",
    }.items():
        with pytest.raises(InputError, match=words):
            load_scanner(write(f"{plain}[readout]\n{lines}\n"), DATA)
