"""What moves on a page: an object, and the first frame of a fly-scan; what the page's script gets, and its budget."""

import base64
import json
from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import Shutter, make_protocol
from phyradgs_cl.fields import Deformation, Grid, deformed
from phyradgs_cl.fields.deformation import control_points
from phyradgs_cl.io import read_volume, sha256_of, write_deformation, write_volume
from phyradgs_cl.report import load_run, report_page
from phyradgs_cl.report.images import Window
from phyradgs_cl.report.motion import MOST_VALUES, fitting, frame_in_motion, object_in_motion
from phyradgs_cl.report.sections import motion_section

pytestmark = pytest.mark.slow

SPAN_S = 0.5, 3.5


def breathing(grid: Grid, spacing_mm: float, rank: int = 2) -> Deformation:
    """Smooth random fields whose weights rise and fall, by about a voxel."""
    origin_mm, counts = control_points(grid, spacing_mm)
    random = np.random.default_rng(5).normal(0, 1, (rank, *counts, 3)) * min(grid.voxel_size_mm)
    times_s = np.linspace(0, 4, 9)
    return Deformation(random, origin_mm, spacing_mm, times_s, np.stack([np.sin(times_s + r) for r in range(rank)], -1))


def rebuilt(data: dict) -> Deformation:
    """The deformation as the script of the page has it."""
    nx, ny, nz = data["shape"]
    whole = np.frombuffer(base64.b64decode(data["control"]), "<i2").reshape(-1, nz, ny, nx, 3)
    control_mm = whole * np.array(data["units_mm"])[:, None, None, None, None]
    return Deformation(control_mm, data["origin_mm"], data["spacing_mm"], data["times_s"], data["weights"])


def test_the_page_has_the_deformation_and_shows_the_first_state(any_volume, parse) -> None:
    """The first picture is the state at the first time, without a script too."""
    volume, grid = any_volume
    field, window = breathing(grid, 0.5), Window.of(0.0, 400.0, volume)
    page = parse(object_in_motion(volume, grid, window, field, SPAN_S))
    data = json.loads(page.texts["script"][0])
    assert not page.open and {"motion-time", "motion-play", "motion-arrows", "motion-z", "motion-slice-x"} <= set(page.ids)
    assert data["first_mm"] == pytest.approx(grid.first_centre_mm[::-1]) and data["span_s"] == list(SPAN_S)
    assert data["step_mm"] == pytest.approx(grid.voxel_size_mm[::-1])
    for time_s in (0.7, 2.2, 3.9):
        shown = rebuilt(data).on_grid_mm(grid, rebuilt(data).weights_at(time_s)[0])
        assert shown == pytest.approx(field.on_grid_mm(grid, field.weights_at(time_s)[0]), abs=1e-4 * field.reach_mm.max())
    state = deformed(volume, grid, field, field.weights_at(0.5)[0])
    assert np.abs(state - volume).max() > 10
    for axis, still in enumerate(page.all("img")):
        middle = np.take(state, volume.shape[axis] // 2, axis=axis)[::-1]
        assert np.abs(page.pixels(still["src"]) - 255 * np.clip(middle / 400, 0, 1)).max() <= 0.51


def test_a_fine_field_and_many_times_stay_within_the_budget() -> None:
    grid = Grid.cube(40, 40.0)
    origin_mm, counts = control_points(grid, 1.0)
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in counts), indexing="ij")
    control_mm, times_s = np.stack([np.sin(2 * z), x * y, np.cos(2 * x)], -1)[None], np.arange(5000.0)
    fine = Deformation(control_mm, origin_mm, 1.0, times_s, np.sin(times_s / 500)[:, None])
    assert fine.control_mm.size > MOST_VALUES
    markup = object_in_motion(np.ones(grid.shape), grid, Window.of(0.0, 1.0, np.ones(1)), fine, (0.0, 4999.0))
    assert len(markup) < 600_000
    reduced = fitting(fine, grid)
    assert reduced.control_mm.size <= MOST_VALUES
    error_mm = np.abs(reduced.on_grid_mm(grid, [1.0]) - fine.on_grid_mm(grid, [1.0]))
    assert error_mm.max() < 0.02 * fine.reach_mm.max()
    assert fitting(breathing(grid, 10.0), grid).control_mm.shape == breathing(grid, 10.0).control_mm.shape


def test_a_run_that_knew_the_motion_has_a_section_of_it(files, tmp_path, parse) -> None:
    """From the file that the provenance names, if it is unchanged, or from the volume file itself."""
    stored, path = read_volume(files[1]), tmp_path / "field.h5"
    field = breathing(stored.grid, 0.5)
    quiet = replace(field, control_mm=0.1 * field.control_mm)
    write_deformation(path, quiet)
    facts = {**stored.provenance, "object_motion": "field.h5", "object_motion_sha256": sha256_of(path)}
    write_volume(tmp_path / "v.h5", stored.values, stored.grid, facts)
    run = load_run(tmp_path / "v.h5", files[0])
    page = parse(report_page(run))
    assert "motion" in page.ids and not run.notes
    limit_mm = (np.abs(quiet.weights) @ quiet.reach_mm).max()
    assert f"Matter moves by less than {limit_mm:.4g} mm" in page.words
    data = next(json.loads(text) for text in page.texts["script"] if "units_mm" in text)
    times_s = run.scan.frame_start_s
    assert data["span_s"] == pytest.approx([times_s[0], times_s[-1] + run.scan.shutter.lit_span_s[1]])
    write_deformation(path, field)
    changed = load_run(tmp_path / "v.h5", files[0])
    assert changed.deformation is None and "has changed since" in changed.notes[0] and motion_section(changed) is None
    write_volume(tmp_path / "found.h5", stored.values, stored.grid, stored.provenance, deformation=quiet)
    assert (load_run(tmp_path / "found.h5").deformation.control_mm == quiet.control_mm).all()


def data_of(parse, scan) -> dict:
    page = parse(frame_in_motion(scan))
    assert not page.open and {"rows", "rows-play", "rows-time", "rows-reset"} <= set(page.ids)
    return json.loads(page.texts["script"][0])


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_lines_and_poses_are_those_of_the_scan(scan_maker, parse, axis) -> None:
    """To a fraction of a pixel between two poses too, where the script interpolates linearly."""
    scan = scan_maker(readout_axis=axis, protocol=make_protocol("rapid", views=8, exposure_deg=20.0))
    data = data_of(parse, scan)
    assert data["axis"] == axis and data["lines"] == list(range(scan.lines)) and data["shape"] == [16, 14]
    assert data["times_s"] == [0.0, pytest.approx(scan.shutter.span_s)]
    times_s = scan.frame_start_s[0] + np.linspace(*data["times_s"], len(data["poses"]))
    assert np.array(data["poses"]) == pytest.approx(scan.trajectory.pose(0, times_s), abs=1e-5)
    angles_deg = np.rad2deg(scan.trajectory.angle_rad(0, times_s))
    assert np.array(data["angles_deg"])[:, 0] == pytest.approx(angles_deg) and np.ptp(angles_deg) > 20
    opens_s, closes_s = np.array(data["opens_s"]), np.array(data["closes_s"])
    assert opens_s == pytest.approx(scan.shutter.delay_s(scan.lines))
    assert closes_s - opens_s == pytest.approx(np.full(scan.lines, scan.shutter.exposure_s))
    poses, times_s = np.array(data["poses"]), np.linspace(*times_s[[0, -1]], 2 * len(times_s) - 1)[1::2]
    error_mm = np.abs((poses[1:] + poses[:-1]) / 2 - scan.trajectory.pose(0, times_s))[:, :6].max()
    assert error_mm < 0.01 * min(scan.geometry.pixel_size_mm)


def test_a_pulse_lights_a_part_of_the_window(scan_maker, parse) -> None:
    scan = scan_maker()
    pulsed = Shutter(scan.shutter.exposure_s, scan.shutter.readout_s, pulse_s=(0.5 * scan.shutter.exposure_s, 0.1))
    data = data_of(parse, replace(scan, shutter=pulsed))
    assert data["times_s"] == pytest.approx([0.5 * scan.shutter.exposure_s, 0.5 * scan.shutter.exposure_s + 0.1])
    assert min(data["opens_s"]) >= data["times_s"][0] - 1e-9 and max(data["closes_s"]) <= data["times_s"][1] + 1e-9
