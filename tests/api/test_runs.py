"""Scans and reconstructions from Python, and figures of them that draw the values of the arrays."""

import json
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest
from matplotlib.figure import Figure

from phyradgs_cl import api
from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.api import Reconstruction, Shutter, reconstruct, runs
from phyradgs_cl.errors import InputError

pytestmark = pytest.mark.slow


def test_a_reconstruction_goes_to_a_file_of_each_suffix_and_back(rt, scan, tmp_path) -> None:
    result = api.reconstruct(scan, "r2", iterations=2, device=rt)
    for suffix in (".nii", ".nii.gz", ".mha", ".nrrd", ".tif", ".tiff", ".npy", ".H5", ""):
        api.save_volume(tmp_path / f"v{suffix}", result)
        again = api.load_volume(tmp_path / f"v{suffix}")
        np.testing.assert_array_equal(again.volume, result.volume, err_msg=suffix)
        assert again.grid.is_close(result.grid), suffix
    assert again.grid == result.grid and again.record == result.record and again.facts["method"] == "r2"
    assert np.allclose(again.gaussians.rows(), result.gaussians.rows(), rtol=1e-6, atol=1e-7)
    for suffix, start in {".ply": b"ply", ".npz": b"PK", ".NII": b"\x5c\x01"}.items():
        api.save_volume(tmp_path / f"v{suffix}", result)
        assert (tmp_path / f"v{suffix}").read_bytes().startswith(start), suffix
    api.save_volume(tmp_path / "v.h5", replace(result, gaussians=None), api.compare(result.volume, scan.reference))
    assert api.load_volume(tmp_path / "v.h5").gaussians is None


def test_threads_have_the_bits_of_runs_alone_and_share_a_device(scan, monkeypatch) -> None:
    def run(weight: float) -> np.ndarray:
        return reconstruct(scan, "fista-tv", iterations=4, size=16, tv_weight=weight, report=False).volume

    weights = [1e-3, 1e-2]
    alone = [run(weight) for weight in weights]
    with ThreadPoolExecutor(2) as pool:
        for found, expected in zip(pool.map(run, 3 * weights), 3 * alone, strict=True):
            np.testing.assert_array_equal(found, expected)
    monkeypatch.setattr(runs, "_runtime_by_name", lru_cache(lambda name: (time.sleep(0.05), object())[1]))
    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(runs.runtime_of, 4 * [None]))) == 1


def test_hounsfield_units_are_kept_by_files(rt, scan, tmp_path) -> None:
    result = api.reconstruct(scan, "FDK", size=[10, 11, 12], voxel_mm=0.15, device=rt)
    assert result.grid == api.Grid((10, 11, 12), (0.15, 0.15, 0.15))
    (z0, z1), (y0, y1), (x0, x1) = result.grid.box_mm
    edge, middle = (z0, z1, y0, y1, x0, x0 + (x1 - x0) / 9), (z0 / 2, z1 / 2, y0 / 2, y1 / 2, x0 / 2, x1 / 2)
    scaled = result.hounsfield(edge, middle)
    for name in ("v.h5", "v.nii", "v.npy"):
        api.save_volume(tmp_path / name, scaled, hu=True)
        np.testing.assert_allclose((again := api.load_volume(tmp_path / name)).volume, result.volume, atol=2e-7)
        assert again.scale.water_per_mm == pytest.approx(scaled.scale.water_per_mm)
    for words, call in {
        "hu: found a result without a scale": lambda: api.save_volume(tmp_path / "v.h5", result, hu=True),
        "hu: given for v.ply": lambda: api.save_volume(tmp_path / "v.ply", scaled, hu=True),
        "^air: found shape": lambda: result.hounsfield((1.0, 2.0)),
        "mu_water_per_mm: given for .*v.h5, which is": lambda: api.load_volume(tmp_path / "v.h5", mu_water_per_mm=0.02),
    }.items():
        with pytest.raises(InputError, match=words):
            call()


def test_xarray_has_the_places_of_voxels_in_mm(monkeypatch) -> None:
    grid = api.Grid((4, 5, 6), (2.0, 1.5, 1.0), (10.0, 0.0, -3.0))
    values = np.random.default_rng(0).uniform(0, 0.02, grid.shape).astype(np.float32)
    states = api.States(np.array([1.0, 4.0]), np.stack([values, 2 * values]))
    result = api.Reconstruction(values, grid, states=states, facts={"hounsfield": {"water_per_mm": 0.02, "air_per_mm": 0.0}})
    array = result.to_xarray()
    assert array.dims == ("z", "y", "x") and array.data is values and array.attrs["units"] == "1/mm"
    assert array["z"].attrs["units"] == "mm"
    place = array.sel(z=11.1, y=-1.4, x=-5.4, method="nearest")
    assert (float(place.z), float(place.y), float(place.x), float(place)) == (11.0, -1.5, -5.5, values[2, 1, 0])
    in_hu = result.to_xarray(hu=True, states=True)
    assert in_hu.dims == ("time", "z", "y", "x") and in_hu.attrs["units"] == "HU" and in_hu["time"].values.tolist() == [1, 4]
    np.testing.assert_allclose(in_hu.sel(time=1.0), 1000 * (values / 0.02 - 1), atol=1e-3)
    for name, words in {"hu": "a scale", "states": "states"}.items():
        with pytest.raises(InputError, match=f"{name}: found a result without {words}"):
            api.Reconstruction(values, grid).to_xarray(**{name: True})
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(InputError, match="xarray: not installed; .*pip install 'xarray'"):
        result.to_xarray()


def softened(volume: np.ndarray, noise: float, share: float = 0.9) -> np.ndarray:
    return share * volume


class Softened:
    """A denoiser with a part that no file can hold."""

    def __init__(self) -> None:
        self.lock = threading.Lock()  # that cannot be copied

    def __call__(self, volume: np.ndarray, noise: float) -> np.ndarray:
        return softened(volume, noise)


def test_a_prior_may_be_a_function(rt, scan, tmp_path) -> None:
    """The facts have its name; a resumed run needs the same name and ends with the same bits."""
    usual = {"iterations": 4, "subvoxels": 1, "device": rt}
    named = {softened: f"{__name__}:softened", Softened(): f"{__name__}:Softened"}
    named[partial(softened, share=0.9)] = "functools:partial"
    whole = [api.reconstruct(scan, "fista", prior=prior, **usual) for prior in named]
    for result, name in zip(whole, named.values(), strict=True):
        assert json.loads(json.dumps(result.facts))["options"]["prior"] == name
        assert np.array_equal(result.volume, whole[0].volume), name

    def stop(progress: api.Progress) -> None:
        if progress.iteration == 2:
            raise KeyboardInterrupt

    part = api.reconstruct(scan, "fista", prior=softened, report=stop, on_interrupt="return", **usual)
    api.save_volume(tmp_path / "part.h5", part)
    part = api.load_volume(tmp_path / "part.h5")
    rest = api.reconstruct(scan, "fista", prior=softened, resume=part, **usual)
    assert np.array_equal(rest.volume, whole[0].volume)
    with pytest.raises(InputError, match="^resume: found a run with other prior"):
        api.reconstruct(scan, "fista", prior=Softened(), resume=part, **usual)


def test_the_command_and_python_make_the_same_scan(rt, tmp_path) -> None:
    options = "--phantom jaw --size 8 --detector 10 --views 2 --noise beer --seed 4 --first left --truncation 0.4"
    assert load_cli().run(["simulate", *options.split(), "-o", str(tmp_path / "scan.h5")]) == 0
    usual = {"size": 8, "detector": 10, "views": 2, "noise": "beer", "seed": 4, "readout_axis": "columns", "device": rt}
    ours, theirs = api.simulate("jaw", truncation=0.4, **usual), api.load_scan(tmp_path / "scan.h5")
    assert ours.projections.shape == (2, 10, 6)
    assert np.array_equal(ours.projections, theirs.projections) and ours.shutter == theirs.shutter
    assert ours.provenance == theirs.provenance and ours.provenance["simulated"] == "phantom jaw"


def titles(figure: Figure) -> list[str]:
    return [axes.get_title() for axes in figure.axes if axes.get_title()]


def texts(figure: Figure) -> set[str]:
    return {text.get_text() for axes in figure.axes for text in axes.texts}


def images(figure: Figure) -> list[np.ndarray]:
    return [np.asarray(image.get_array()) for axes in figure.axes for image in axes.get_images()]


def test_a_frame_has_its_picture_its_windows_and_its_arc(scan) -> None:
    mask = np.zeros(scan.geometry.detector_shape)
    mask[3, 4] = 1
    figure = replace(scan, pixel_mask=mask, shutter=Shutter(1.0, 0.86, "rows", -1, (0.4, 0.6))).plot(2)
    assert titles(figure) == ["frame 2 of 6: line integrals", "gantry from 120.0° to 175.8°"]
    (picture,) = images(figure)
    known = np.isfinite(picture)
    np.testing.assert_array_equal(picture[known], scan.projections[2][known])
    assert not known[3, 4] and "1 mm" in texts(figure)  # the bar of a panel of 4 mm
    windows = figure.axes[1]
    assert windows.get_xlabel() == "time after the frame's start (s)" and windows.get_ylabel() == "detector row"
    low, high = windows.dataLim.intervalx
    assert (low, high) == pytest.approx((0.0, 1.86))
    assert "the gantry stands still" in texts(replace(scan, is_fly=False).plot())


def test_a_result_has_slices_convergence_and_a_residual(rt, scan) -> None:
    result = reconstruct(scan, "sirt", iterations=4, motion="per-row", device=rt)
    alone = result.plot()
    assert [t.split(",")[0] for t in titles(alone)] == ["result"] * 3 + ["convergence"]
    np.testing.assert_array_equal(images(alone)[1], result.volume[:, 6])
    curve = next(axes for axes in alone.axes if axes.get_title() == "convergence")
    np.testing.assert_array_equal(curve.lines[0].get_ydata(), [line["residual"] for line in result.record])
    assert curve.get_ylabel() == "residual" and curve.get_xlabel() == "iteration" and "0.5 mm" in texts(alone)
    whole = result.plot(scan, frame=3, device=rt)
    assert len(images(whole)) == 3 * 3 + 2 and len(images(Reconstruction(result.volume, result.grid).plot())) == 3
    np.testing.assert_array_equal(images(whole)[-2], scan.projections[3])
    share = np.linalg.norm(images(whole)[-1]) / np.linalg.norm(scan.projections[3])
    assert 0 < share < 1 and f"RMS {100 * share:.2g} %" in titles(whole)[-1]


def test_pyplot_shows_it_where_somebody_has_imported_that(scan, monkeypatch) -> None:
    import matplotlib.pyplot as plt

    assert plt.fignum_exists((figure := scan.plot()).number)
    plt.close(figure)
    monkeypatch.delitem(sys.modules, "matplotlib.pyplot")
    assert not hasattr(scan.plot(), "number")
