"""What the toolkit is worth, as numbers: methods on a fixed fly-scan, a calibration, and the commands from a spoilt scan on.

Each number was measured when this was written. A change that raises one moves it here; one that lowers it has to say why.
"""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from phyradgs_cl import api

PSNR_DB = {
    # method, motion, options: dB and its tolerance; Gaussians follow rounding, so that devices differ more
    ("fdk", "static"): ({}, 28.54, 0.02),
    ("fdk", "per-row"): ({}, 28.99, 0.02),
    ("fista", "static"): ({}, 33.88, 0.05),
    ("fista", "per-row"): ({}, 37.26, 0.05),
    ("phyradgs", "exact"): ({"iterations": 200}, 31.55, 0.5),
}
OFFSET_MM = 0.2


@pytest.fixture(scope="module")
def scan() -> api.Scan:
    """24³ voxels of a foot from 25 rapid frames of 48², with TIGRE's noise."""
    return api.simulate("foot", size=24, detector=48, protocol="rapid", noise="tigre", dose=1e4, seed=0)


RUNS = [pytest.param(*run, marks=pytest.mark.slow if run[0] == "phyradgs" else ()) for run in PSNR_DB]


@pytest.mark.parametrize(("method", "motion"), RUNS)
def test_a_method_is_as_right_as_it_was(scan: api.Scan, method: str, motion: str) -> None:
    options, expected_db, tolerance_db = PSNR_DB[method, motion]
    result = api.reconstruct(scan, method=method, motion=motion, seed=0, report=False, **options)
    psnr_db = api.compare(result.volume, scan.reference)["psnr_db"]
    assert psnr_db == pytest.approx(expected_db, abs=tolerance_db)


@pytest.mark.slow
def test_commands_mend_a_scan_with_rings_and_a_displaced_panel(cli, tmp_path: Path, capsys, fast_pictures) -> None:
    """Prepare, calibrate, reconstruct, evaluate: 12 dB regained of 20, on a scan almost too small for it."""
    options = {"size": 16, "detector": 32, "views": 48, "exposure_deg": 5.0, "noise": "tigre", "dose": 1e5, "seed": 0}
    displaced = api.simulate("jaw", rings=0.03, detector_offset_mm=(0.0, OFFSET_MM), **options)
    faultless = api.simulate("jaw", detector_offset_mm=(0.0, OFFSET_MM), **options)
    geometry = replace(displaced.geometry, detector_offset_mm=(0.0, 0.0))
    spoilt = replace(displaced, geometry=geometry, trajectory=replace(displaced.trajectory, geometry=geometry))

    def psnr_db(name: str, *more: str) -> float:
        volume = tmp_path / f"{name}_volume.h5"
        assert cli.run(["reconstruct", str(tmp_path / f"{name}.h5"), "-o", str(volume), *more]) == 0
        capsys.readouterr()
        assert cli.run(["evaluate", str(volume), "--reference", str(tmp_path / "faultless.h5"), "--json"]) == 0
        return json.loads(capsys.readouterr().out)["psnr_db"]

    api.save_scan(tmp_path / "faultless.h5", faultless)
    api.save_scan(tmp_path / "spoilt.h5", spoilt)
    assert cli.run(["prepare", str(tmp_path / "spoilt.h5"), "-o", str(tmp_path / "prepared.h5")]) == 0
    command = ["calibrate", str(tmp_path / "prepared.h5"), "--what", "offset", "-o", str(tmp_path / "mended.h5")]
    assert cli.run(command) == 0
    mended = api.load_scan(tmp_path / "mended.h5")
    offset_mm = mended.trajectory.geometry.detector_offset_mm[1]
    assert offset_mm == pytest.approx(0.184, abs=0.005)
    assert psnr_db("mended") == pytest.approx(31.2, abs=0.3)
    assert psnr_db("spoilt", "--iterations", "30") < 20  # no more of them help
