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
lag = 0.03
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
[beam]
pulse_start = 0.5
pulse_length = 0.25
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
    """Editors of Windows write a byte order mark; lag, volume, readout and beam may be left out."""
    for text in (GOOD, "\ufeff" + GOOD, GOOD.replace("[source]", '[source]\nbeam = "cone"')):
        scanner = load_scanner(write(text), DATA)
        assert scanner.geometry == ConeGeometry(500.0, 1000.0, (40, 60), (2.0, 1.0), (0.0, 3.5))
        assert scanner.grid == Grid((10, 20, 40), (1.0, 1.0, 2.0), (1.0, 2.0, 3.0))
        assert (scanner.readout_axis, scanner.readout_direction, scanner.readout_ratio) == ("columns", -1, 0.5)
        assert scanner.pulse == (0.5, 0.25) and scanner.lag == 0.03
    scanner = load_scanner(write(GOOD.split("[volume]")[0].replace("lag = 0.03", "")), DATA)
    assert scanner.grid == default_grid(scanner.geometry) and scanner.pulse is None and scanner.lag == 0
    assert (scanner.readout_axis, scanner.readout_direction, scanner.readout_ratio) == ("rows", 1, None)
    parallel = GOOD.replace("to_axis_mm = 500\nto_detector_mm = 1000.0", 'beam = "parallel"')
    assert load_scanner(write(parallel), DATA).geometry == ParallelGeometry((40, 60), (2.0, 1.0), (0.0, 3.5))


WRONG = {  # by the place that a message names: what is there in a good file, and instead of it
    "volumes": [("[volume]", "[volumes]")], "": [("[source]", "[source")], "[readout]": [("[readout]", "[[readout]]")],
    "[source] beam": [("to_axis_mm = 500", 'beam = "fan"')],
    "[source] to_axis_mm": [
        ("to_axis_mm = 500", ""), ("to_axis_mm = 500", 'to_axis_mm = "500"'), ("[source]", '[source]\nbeam = "parallel"'),
    ],
    "[source] to_detector_mm": [("to_detector_mm = 1000.0", "to_detector_mm = 400")],
    "[detector] colums": [("rows = 40", "rows = 40\ncolums = 60")], "[detector] lag": [("lag = 0.03", "lag = 1.0")],
    "[detector] rows": [("rows = 40", f"rows = {rows}") for rows in (10**400, 40.5, "true")],
    "[volume] size_mm": [("[10.0, 20.0, 80.0]", "[10.0, 0, 80.0]")],
    "[volume] shape": [("shape = [10, 20, 40]", f"shape = {shape}") for shape in ([10, 20], 10, [10, 0, 40])],
    "[readout] axis": [('axis = "columns"', 'axis = "cols"')], "[readout] direction": [("direction = -1", "direction = 0")],
    "[readout] first": [("direction = -1", 'first = "top"')],
    "[readout] readout_ms": [("direction = -1", "readout_ms = 62")],
    "[beam] pulse_length": [("pulse_length = 0.25", "")],
}  # fmt: skip


def test_errors_name_table_and_key(write, tmp_path) -> None:
    for where, changes in WRONG.items():
        for old, new in changes:
            assert old in GOOD
            path = write(GOOD.replace(old, new, 1))
            with pytest.raises(InputError) as caught:
                load_scanner(path, DATA)
            text = str(caught.value)
            assert text.startswith(f"{path} {where}".strip()) and "\n" not in text, text
    for name, words in (("carmm", r"did you mean 'carm'"), (tmp_path / "none.toml", "no such file")):
        with pytest.raises(InputError, match=words):
            load_scanner(name, DATA)


def test_another_count_keeps_the_panel() -> None:
    coarse = with_detector_count(geometry := ConeGeometry(500.0, 1000.0, (40, 60), (2.0, 1.0), (1.0, 3.5)), 10, 15)
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
