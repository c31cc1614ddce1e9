"""Raw projections of makers, read by the package itk-rtk, where that is installed (conftest.py)."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from makers_of_importers import AIR, write_elekta, write_obi, write_ora, write_probeam

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan, recognise

# RTK takes Elekta's panel for 409.6 mm, and .hnd to have a multiple of four columns
GEOMETRIES = {
    "elekta": ConeGeometry(1000.0, 1536.0, (72, 92), (409.6 / 80, 409.6 / 100), (-3.0, 2.0)),
    "obi": ConeGeometry(500.0, 800.0, (10, 16), (3.0, 2.5), (4.0, -6.0)),
}
MAKERS: dict[str, tuple[Callable[[Path, Any], Path], str]] = {
    "elekta": (write_elekta, "_Frames.xml"),
    "obi": (partial(write_obi, suffix="hnd"), "ProjectionInfo.xml"),
    "obi-16-bits": (partial(write_obi, suffix="hnc", fan="FullFan"), "ProjectionInfo.xml"),
    "probeam": (write_probeam, "Scan.xml"),
    "ora": (write_ora, "00000.ora.xml"),
}


@pytest.fixture
def make_files(tmp_path, make_truth) -> Callable[[str], tuple[Path, Any]]:
    """The factory of a maker's folder and the truth that it describes."""

    def make(maker: str) -> tuple[Path, Any]:
        truth = make_truth(geometry=GEOMETRIES[maker]) if maker in GEOMETRIES else make_truth()
        return MAKERS[maker][0](tmp_path / maker, truth), truth

    return make


@pytest.mark.parametrize("maker", MAKERS)
def test_projections_of_a_maker_with_their_geometry(maker, make_files, assert_same) -> None:
    path, truth = make_files(maker)
    assert recognise(path) == recognise(path / MAKERS[maker][1]) == "rtk-projections"
    scan = import_scan(path)
    assert scan.frames == truth.scan.frames
    assert_same(scan, truth, grid=False, pixels=1e-3 if maker == "elekta" else 1e-4)  # whole counts


def test_a_rate_and_an_exposure_make_a_fly_scan_on_a_circle(make_files) -> None:
    scan = import_scan(make_files("elekta")[0], ImportOptions(exposure_s=0.4, fps=0.8))
    assert isinstance(scan.trajectory, CircularOrbit)
    assert scan.is_fly and scan.shutter.exposure_s == 0.4


@pytest.mark.parametrize(
    ("maker", "suffix"), [("elekta", "his"), ("obi", "hnd"), ("obi-16-bits", "hnc"), ("probeam", "xim")]
)
def test_the_counts_of_air_replace_those_that_rtk_takes(maker, suffix, make_files) -> None:
    path, truth = make_files(maker)
    brighter = import_scan(path, ImportOptions(flat_value=2.0 * AIR[suffix]))
    difference = brighter.projections - truth.scan.projections
    np.testing.assert_allclose(difference, np.log(2), atol=1e-3)


def test_options_that_mean_nothing_are_refused(make_files) -> None:
    path, _ = make_files("ora")
    for options in (ImportOptions(flat_value=5e4), ImportOptions(quantity="counts")):
        with pytest.raises(InputError, match="with format rtk-projections"):
            import_scan(path, options)


def test_two_acquisitions_of_a_truebeam_are_not_one_scan(make_files) -> None:
    path, _ = make_files("probeam")
    other = path / "Acquisitions" / "2"
    other.mkdir()
    (other / "Proj_00000.xim").write_bytes(b"VMS.XI")
    with pytest.raises(InputError, match="found projections of several acquisitions"):
        import_scan(path)


def test_what_rtk_does_not_read_is_one_error_of_one_line(make_files) -> None:
    path, _ = make_files("elekta")
    (path / "00003.his").write_bytes(b"none")
    with pytest.raises(InputError, match="elekta: found files that RTK does not read") as caught:
        import_scan(path)
    assert "\n" not in str(caught.value)
    (path / "00003.his").unlink()
    with pytest.raises(InputError, match="found 5 frames, 6 projections in _Frames.xml"):
        import_scan(path)


def test_a_description_alone_is_not_taken(make_files) -> None:
    path, _ = make_files("elekta")
    for file in path.glob("*.his"):
        file.unlink()
    with pytest.raises(InputError, match="found no description with projections"):
        import_scan(path, form="rtk-projections")
