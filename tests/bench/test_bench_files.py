"""Results files, folders of volumes, rows and jobs: all that needs no device."""

import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tables import (
    KINDS,
    RESULTS,
    BenchJob,
    BenchSize,
    Row,
    listed,
    listed_seeds,
    plan_runs,
    rows_of,
    run_bench,
)
from tables import rows as bench_rows
from tables.case import FLY, STILL
from tables.figures import read_slices, slices_path, write_slices
from tables.gains import gain_over_static
from tables.published import TABLE1, TABLE2
from tables.results import _MEASURED, KEY, Present, append_line, read_lines
from tables.summary import summarise
from tables.volumes import find_volumes

from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.reconstructors import METHODS

FACTS = {
    **dict.fromkeys(KEY, 1),
    **{name: "a" if kind.fits("a") else 1 for name, kind in _MEASURED.items()},
    "options": {"motion": {"name": "static"}, "iterations": 5},
    "metrics": {},
}


def test_a_damaged_last_line_is_closed_off(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, notes = tmp_path / "results.jsonl", tmp_path / "notes.jsonl"
    assert read_lines(path) == []
    append_line(path, {**FACTS, "run": "a"})
    with open(path, "a") as file:
        file.write('{"run": "b", "seed": 1, "metr')
    assert [line["run"] for line in read_lines(path)] == ["a"] and "line 2 is damaged" in caplog.text
    append_line(path, {**FACTS, "run": "c"})
    assert [line["run"] for line in read_lines(path)] == ["a", "c"]
    notes.write_text("these are\nnotes\n")
    with pytest.raises(InputError, match="no result in any line"):
        read_lines(notes)
    with pytest.raises(OutputError, match="missing"):
        append_line(tmp_path / "missing" / "results.jsonl", {})


def test_devices_and_pipes_are_no_results_files(tmp_path: Path) -> None:
    endless, pipe = tmp_path / "endless.jsonl", tmp_path / "pipe.jsonl"
    endless.symlink_to("/dev/zero")
    os.mkfifo(pipe)
    for path in (endless, pipe):
        with pytest.raises(InputError, match="not a regular file"):
            read_lines(path)
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / RESULTS).symlink_to(pipe)
    with pytest.raises(InputError, match="not a regular file"):
        run_bench(BenchJob("table1", folder, rows=["FDK"]), pytest.fail)  # type: ignore[arg-type]


def test_damaged_slices_are_none_at_all(tmp_path: Path) -> None:
    images = [np.full((3, 4), float(n), np.float32) for n in range(3)]
    facts = {**FACTS, "volume": "jaw"}
    write_slices(tmp_path, facts, images)
    np.testing.assert_array_equal(read_slices(tmp_path, facts), images)
    path = slices_path(tmp_path, facts)

    def bomb(path: Path) -> None:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("arr_0.npy", b"\0" * (300 << 20))

    for damage in (
        lambda path: path.write_bytes(path.read_bytes()[:200]),
        bomb,
        lambda path: np.savez(path, np.array([path], object)),
        lambda path: np.savez(path, volume=images[0]),
        Path.unlink,
    ):
        damage(path)
        assert read_slices(tmp_path, facts) is None


def test_a_run_is_present_with_the_same_identity_and_options() -> None:
    present = Present([FACTS])
    assert present.has(FACTS)
    for name in KEY:
        assert not present.has({**FACTS, name: 2})
    assert not present.has({**FACTS, "options": {"motion": {"name": "per-row"}, "iterations": 5}})
    # an option that the program has gained since is no reason to run again
    assert present.has({**FACTS, "options": {**FACTS["options"], "new": 1}})
    assert not Present([{**FACTS, "error": "overflow"}]).has(FACTS)


def test_of_a_volume_twice_the_size_is_taken_else_the_largest(tmp_path: Path) -> None:
    for name in ("head_64", "head_128", "head_256", "plain", "two_words_32"):
        (tmp_path / f"{name}.h5").touch()
    found = {name: path.stem for name, path in find_volumes(tmp_path, None, 64).items()}
    assert found == {"head": "head_128", "plain": "plain", "two_words": "two_words_32"}
    assert find_volumes(tmp_path, ["head"], 256)["head"].stem == "head_256"
    with pytest.raises(InputError, match="--names: found 'heat'; .*did you mean 'head'"):
        find_volumes(tmp_path, ["heat"], 64)


def test_folders_without_volumes_are_refused(tmp_path: Path) -> None:
    for folder, said in ((tmp_path, r"no \.h5 file in"), (tmp_path / "missing", "a folder of HDF5 volumes")):
        with pytest.raises(InputError, match=said):
            find_volumes(folder, None, 64)


def test_rows_are_the_papers_and_more() -> None:
    labels = {kind: [row.label for row in rows_of(kind)] for kind in KINDS}
    assert set(TABLE1) <= set(labels["table1"]) and set(TABLE2) == set(labels["table2"])
    for kind in KINDS:
        assert len(set(labels[kind])) == len(labels[kind])
        assert all(row.options(100, 10).motion.name == row.motion for row in rows_of(kind))
    # tables share the run of the default strips
    row = {row.label: row for kind in ("table1", "table2") for row in rows_of(kind)}
    full = row["PhyRadGS"]
    assert (full.run, full.static().run) == (row["M=8 N=5"].run, row["PhyRadGS w/o ST"].run)


def test_a_row_of_an_unknown_name_or_method_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--rows: found 'PhyRad'; .*did you mean 'PhyRadGS'"):
        BenchJob("table1", tmp_path, rows=["PhyRad"])
    for row, said in (
        (Row("Magic", "magic"), "row 'Magic': found the method 'magic'; expected one of phyradgs"),
        (Row("R2 exact", "r2", "per-row"), "row 'R2 exact': --motion"),
    ):
        with pytest.raises(InputError, match=said):
            row.options(10, 10)


def test_a_method_of_ones_own_has_rows_under_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(METHODS, "landweber", METHODS["sirt"])
    job = BenchJob("table1", tmp_path, rows=["landweber per-row", "landweber"])
    assert [row.run for row in job.chosen_rows] == ["landweber static", "landweber per-row"]
    assert job.chosen_rows[1].static().run == "landweber static"
    assert "landweber" not in [row.label for row in rows_of("table1")]


def test_stop_and_shoot_is_planned_once_for_the_rows_that_share_it(tmp_path: Path) -> None:
    rows = ["PhyRadGS", "PhyRadGS w/o ST", "R2-Gaussian w/ ST"]
    job = BenchJob("table1", tmp_path, rows=rows, names=["foot"], protocols=["rapid"], iterations=7)
    planned = [(run.acquisition, run.row.label) for run in plan_runs(job)]
    still = [("stop-and-shoot", label) for label in ("PhyRadGS w/o ST", "R2-Gaussian")]
    assert sorted(planned) == sorted([*(("fly-scan", label) for label in rows), *still])
    assert {(run.options.iterations, run.options.gaussians) for run in plan_runs(job)} == {(7, job.gaussians)}


def test_a_plan_runs_over_seeds_volumes_and_protocols(tmp_path: Path) -> None:
    job = BenchJob("table1", tmp_path, rows=["FDK"], seeds=(0, 1))
    cases = [run.case for run in plan_runs(job)]
    assert len(set(cases)) == 2 * 2 * 2
    assert len(cases) == 2 * len(set(cases))  # on a moving and on a gantry at rest
    assert json.loads(json.dumps([run.facts for run in plan_runs(job)]))


@pytest.mark.parametrize(
    ("torch", "gpu", "size", "methods"),
    [
        (False, False, "XS", {"fdk"}),
        (True, False, "M", {"fdk", "naf"}),
        (True, False, "L", {"fdk"}),
        (True, True, "L", {"fdk", "naf"}),
    ],
)
def test_neural_rows_run_where_their_machine_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, torch: bool, gpu: bool, size: str, methods: set[str]
) -> None:
    monkeypatch.setattr(bench_rows, "has_torch", lambda: torch)
    monkeypatch.setattr(bench_rows, "has_accelerator", lambda: gpu)
    job = BenchJob("table1", tmp_path, size=size, rows=["NAF", "FDK"], names=["jaw"], protocols=["rapid"])
    assert {run.row.method for run in plan_runs(job)} == methods


def test_wrong_jobs_are_refused(tmp_path: Path) -> None:
    job = BenchJob("table1", tmp_path, rows=["FDK"])
    for changes, subject in (
        ({"kind": "table3"}, "benchmark: found 'table3'"),
        ({"protocols": ["static"]}, "--protocols: found 'static'"),
        ({"seeds": (-1,)}, "--seeds: found -1"),
        ({"seeds": ()}, "--seeds: found nothing"),
        ({"iterations": -1}, "--iterations: found -1"),
        ({"size": "XXL"}, "--size: found 'XXL'"),
        ({"axis": "diagonal"}, "--readout: found 'diagonal'"),
        ({"names": ["hand"]}, r"--names \(without --volumes\): found 'hand'"),
        ({"kind": "phantom", "names": ["foot"]}, "given for phantom"),
    ):
        with pytest.raises(InputError, match=subject):
            plan_runs(replace(job, **changes))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="voxels of a benchmark size"):
        BenchSize("T", 1, 8, 1)


def test_lists_of_the_command_line() -> None:
    assert listed("--names", "a, b") == ["a", "b"]
    assert listed("--names", None) is None
    assert listed_seeds("--seeds", "0,12") == [0, 12]
    for text in ("", "a,,b"):
        with pytest.raises(InputError, match="--names"):
            listed("--names", text)
    with pytest.raises(InputError, match="--seeds: found '1,x'"):
        listed_seeds("--seeds", "1,x")


def test_a_spread_tells_of_seeds_and_not_of_volumes() -> None:
    """Three volumes with one seed, one of them with two: its two seeds are the spread, and it weighs as any other."""
    found = [("a", 0, 20.0), ("b", 0, 30.0), ("c", 0, 40.0), ("a", 1, 22.0)]
    lines = [{"volume": v, "seed": seed, "metrics": {"psnr_db": db, "ssim": None}} for v, seed, db in found]
    lines[-1]["processor_s"] = 3.0
    summary = summarise(lines)
    assert summary is not None
    assert summary.mean == {"psnr_db": pytest.approx((21 + 30 + 40) / 3), "processor_s": 3.0}
    assert summary.spread == {"psnr_db": pytest.approx(np.std([20, 22], ddof=1))}
    assert (summary.volumes, summary.seeds) == (3, 2)
    apart = summarise([lines[1], lines[3]])  # seeds of different volumes: their difference is that of volumes
    assert apart is not None and apart.spread == {}
    assert summarise([]) is None


# --- what a model of the motion gives: pairs of the same volume and seed, and nothing else ------------------------------

ROWS = {row.label: row for row in rows_of("table1")}
MOVING, STATIC = ROWS["SART per-row"], ROWS["SART"]


def line(row: Row, volume: str, seed: int, psnr_db: float, **others: Any) -> dict[str, Any]:
    """A line of a results file as far as a gain looks at it."""
    facts = {"run": row.run, "protocol": "rapid", "acquisition": FLY, "processor_s": 2.0, **others}
    return {**facts, "volume": volume, "seed": seed, "metrics": {"psnr_db": psnr_db, "ssim": 0.5}}


LINES = [
    *(line(STATIC, *where) for where in (("a", 0, 20.0), ("a", 1, 22.0), ("b", 0, 30.0))),
    *(line(MOVING, *where) for where in (("a", 0, 21.0), ("a", 1, 25.0))),
    line(MOVING, "b", 0, 30.5, processor_s=8.0),
]


def test_a_gain_is_the_mean_over_volumes_of_the_means_over_their_seeds() -> None:
    gain = gain_over_static(LINES, "rapid", MOVING)
    assert gain is not None
    assert (gain.least_db, gain.greatest_db) == (0.5, 2.0)
    assert gain.mean_db == pytest.approx(1.25)
    assert gain.mean_db == pytest.approx(gain.moving.mean["psnr_db"] - gain.static.mean["psnr_db"])
    assert gain.moving.mean["processor_s"] == 5.0
    assert (gain.volumes, gain.still) == (2, None)


def test_scans_without_a_partner_and_perfect_volumes_do_not_count() -> None:
    gain = gain_over_static(LINES, "rapid", MOVING)
    alone = [line(STATIC, "c", 0, 90.0), line(MOVING, "a", 2, 90.0), line(MOVING, "d", 0, 90.0)]
    for more in (alone, [line(MOVING, "a", 0, 90.0, protocol="standard")]):
        assert gain_over_static([*LINES, *more], "rapid", MOVING) == gain
    assert gain_over_static([line(STATIC, "a", 0, 20.0), line(MOVING, "a", 1, 21.0)], "rapid", MOVING) is None
    assert gain_over_static(LINES, "rapid", ROWS["CGLS per-row"]) is None
    perfect = {**line(MOVING, "b", 0, 0.0), "metrics": {"psnr_db": None, "ssim": 1.0}}
    gain = gain_over_static([*LINES[:5], perfect], "rapid", MOVING)
    assert gain is not None and (gain.volumes, gain.mean_db) == (1, 2.0)


def test_a_static_row_has_no_gain_and_stop_and_shoot_is_of_the_same_scans() -> None:
    assert gain_over_static(LINES, "rapid", STATIC) is None
    still = [line(STATIC, volume, 0, psnr, acquisition=STILL) for volume, psnr in (("a", 40.0), ("c", 90.0))]
    gain = gain_over_static([*LINES, *still], "rapid", MOVING)
    assert gain is not None and gain.still is not None
    assert gain.still.mean["psnr_db"] == 40.0
