"""Flats that change while a scan is taken."""

import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import load_scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import write_scan
from phyradgs_cl.prepare import flat_correction
from phyradgs_cl.reconstructors import Preprocessing
from phyradgs_cl.reconstructors.preprocess import prepared

pytestmark = pytest.mark.slow

DARK = 100.0


def counts(clean: Scan, components: int) -> tuple[np.ndarray, np.ndarray]:
    """Counts (F, v, u) and keys of a scan, a dark and three groups of flats, under light whose pattern drifts."""
    rng = np.random.default_rng(5)
    p = np.maximum(clean.projections, 0)
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


@pytest.mark.parametrize(("way", "components"), [("time", 1), ("pca", 2)])
def test_a_drifting_pattern_is_taken_out(planted, way, components) -> None:
    clean = planted(noise="none", dose=None)
    data, key = counts(clean, components)
    error = {}
    for how in ("mean", way):
        found, bad = flat_correction(how)(data, key, "counts")
        error[how] = float(np.sqrt(np.mean((found - np.maximum(clean.projections, 0))[~bad] ** 2)))
    assert error[way] < 0.25 * error["mean"], error


def test_files_are_read_with_them_and_scans_of_line_integrals_refused(planted, tmp_path) -> None:
    clean = planted(noise="none", dose=None)
    data, key = counts(clean, 1)
    write_scan(tmp_path / "counts.h5", clean, data=data, image_key=key, quantity="counts")
    found, mean = load_scan(tmp_path / "counts.h5", flats="time"), load_scan(tmp_path / "counts.h5")
    assert np.abs(found.projections - mean.projections).max() > 0.01
    assert prepared(found, Preprocessing(flats="time")) is found
    for call in (
        lambda: prepared(clean, Preprocessing(flats="time")),
        lambda: Preprocessing(flats="median"),
        lambda: flat_correction("pca")(data, np.where(key == 1, 3, key), "counts"),
    ):
        with pytest.raises(InputError, match="flats"):
            call()
