"""Flats that change while a scan is taken."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import load_scan
from phyradgs_cl.check.detector import CountReader
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan
from phyradgs_cl.io import read_scan, write_scan
from phyradgs_cl.prepare import flat_correction
from phyradgs_cl.reconstructors import Preprocessing
from phyradgs_cl.reconstructors.preprocess import prepared

DARK = 100.0


def counts(clean: Scan, components: int) -> tuple[np.ndarray, np.ndarray]:
    """Counts (F, v, u) and keys of a scan, a dark and three groups of flats, under light whose pattern drifts."""
    rng, p = np.random.default_rng(5), np.maximum(clean.projections, 0)
    patterns = [np.add.outer(np.zeros(p.shape[1]), np.sin(np.arange(p.shape[2]) / (2.0 + k))) for k in range(components)]
    third = len(p) // 2
    key = np.array([2, 1, 1, *[0] * third, 1, 1, *[0] * (len(p) - third), 1, 1])
    data, frames = np.empty((len(key), *p.shape[1:])), iter(p)
    for i, kind in enumerate(key):
        time = i / len(key) if components == 1 else rng.uniform(-1, 1)
        drift = np.exp(sum(0.1 * (time if components == 1 else rng.uniform(-1, 1)) * pattern for pattern in patterns))
        light = 5e4 * drift * (np.exp(-next(frames)) if kind == 0 else 1)
        data[i] = DARK if kind == 2 else light + DARK + rng.normal(0, 5, p.shape[1:])
    return data.round().astype(np.uint16), key


@pytest.mark.slow
@pytest.mark.parametrize(("way", "components"), [("time", 1), ("pca", 2)])
def test_a_drifting_pattern_is_taken_out(planted, way, components) -> None:
    clean = planted(noise="none", dose=None)
    data, key = counts(clean, components)
    error = {}
    for how in ("mean", way):
        found, bad = flat_correction(how)(data, key, "counts")
        error[how] = float(np.sqrt(np.mean((found - np.maximum(clean.projections, 0))[~bad] ** 2)))
    assert error[way] < 0.25 * error["mean"], error


@pytest.mark.slow
def test_files_are_read_with_them_and_scans_of_line_integrals_refused(planted, tmp_path) -> None:
    clean = planted(noise="none", dose=None)
    data, key = counts(clean, 1)
    write_scan(tmp_path / "counts.h5", clean, data=data, image_key=key, quantity="counts")
    found, mean = load_scan(tmp_path / "counts.h5", flats="time"), load_scan(tmp_path / "counts.h5", flats="mean")
    assert np.abs(found.projections - mean.projections).max() > 0.01
    assert prepared(found, Preprocessing(flats="time")) is found
    for call in (
        lambda: prepared(clean, Preprocessing(flats="time")),
        lambda: Preprocessing(flats="median"),
        lambda: flat_correction("pca")(data, np.where(key == 1, 3, key), "counts"),
    ):
        with pytest.raises(InputError, match="flats"):
            call()


KEYS = [2, 1, 1, *[0] * 8, 3, 3, 1, 1, *[0] * 8, 1, 1, 2]  # two invalid frames before the middle flats
NUMBERS = np.arange(len(KEYS), dtype=np.float64)
PAUSES = NUMBERS + 100.0 * (NUMBERS > 11) + 7.0 * (NUMBERS > 14)
FLATS_AND_INVALID = np.isin(KEYS, (1, 3))


@pytest.mark.parametrize(
    ("place", "light_at", "stated"),
    [
        ("frame_start_time", PAUSES, PAUSES),
        ("frame_start_time", NUMBERS, None),
        ("frame_start_time", NUMBERS, np.where(FLATS_AND_INVALID, 0.0, PAUSES)),  # nothing is known of the flats
        ("frame_start_time", NUMBERS, np.where(FLATS_AND_INVALID, np.roll(PAUSES, 1), PAUSES)),  # as write_scan stores it
        ("frame_start_time", PAUSES, np.where(np.equal(KEYS, 2), 0.0, PAUSES)),  # darks need no time
        ("start_time", PAUSES, PAUSES),  # NeXus' own name, of the import alone
        ("start_time", NUMBERS, "2026-01-01T00:00:00"),
    ],
)
def test_flats_are_taken_at_the_times_that_the_file_states(tmp_path, place, light_at, stated) -> None:
    """Of a beam that falls linearly by a fifth, with a pause before the middle flats, nothing is left in the air."""
    light = 30000 * (1 - 0.2 * light_at / light_at[-1])
    frames = np.broadcast_to(np.where(np.equal(KEYS, 2), 0, light)[:, None, None], (len(KEYS), 6, 8))
    file = nxtomo(tmp_path / "scan.nxs", frames, place, stated)
    found = [import_scan(file, ImportOptions(flats=way)) for way in (None, "time")]
    assert all("of 3 times, interpolated" in scan.provenance["taken"] for scan in found)
    if place == "frame_start_time":  # the only one in scan files
        found += [load_scan(file, flats="time"), load_scan(file)]
        found += [read_scan(file, reader) for reader in (CountReader(), counts_to_attenuation)]
        assert np.abs(load_scan(file, flats="mean").projections).max() > 0.05
    for scan in found:
        np.testing.assert_allclose(scan.projections, 0, atol=1e-4)


def nxtomo(path: Path, frames: np.ndarray, place: str, times: object) -> Path:
    mm = {"detector/x_pixel_size": 0.5, "detector/y_pixel_size": 0.5, "detector/distance": 50.0, "source/distance": 100.0}
    with_units = {f"instrument/{name}": (value, "mm") for name, value in mm.items()}
    with_units["sample/rotation_angle"] = 10.0 * np.arange(len(KEYS)), "deg"
    with h5py.File(path, "w") as file:
        file["entry/definition"] = "NXtomo"
        detector = file.create_group("entry/instrument/detector")
        detector.create_dataset("data", data=frames.round().astype(np.uint16)).attrs["quantity"] = "counts"
        detector["image_key"] = np.array(KEYS, np.int32)
        if times is not None:
            detector[place] = times
        for name, (value, unit) in with_units.items():
            file[f"entry/{name}"] = value
            file[f"entry/{name}"].attrs["units"] = unit
    return path
