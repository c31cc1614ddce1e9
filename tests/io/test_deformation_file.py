"""Files of deformations: the same values back, and one line about the HDF5 path of any damage."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from damage import Change, attribute, on, removed, value

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, MovingTruth
from phyradgs_cl.io import file_kind, read_deformation, read_scan, scan_summary, write_deformation, write_scan

GROUP = "/entry/deformation"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    control_mm = np.random.default_rng(0).normal(size=(2, 3, 4, 5, 3)) * 0.1
    field = Deformation(control_mm, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), np.array([0.0, 1.5, 9.0]), np.eye(3, 2))
    write_deformation(path := tmp_path / "field.h5", field)
    return path


def test_values_come_back_in_mm_and_s(path: Path) -> None:
    before = read_deformation(path)
    with h5py.File(path, "r+") as file:
        times = file[f"{GROUP}/times"]
        times[...], times.attrs["units"] = times[...] * 1000, "ms"
        spacing = file[f"{GROUP}/spacing"]
        spacing[...], spacing.attrs["units"] = spacing[...] / 10, "cm"
    after = read_deformation(path)
    assert file_kind(path) == "deformation" and after.origin_mm == (1.0, 2.0, 3.0)
    for name in ("control_mm", "spacing_mm", "times_s", "weights"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), rtol=1e-15)


def _folded(file: h5py.File, address: str) -> None:
    file[address][0, 1, 1, 1] = [0.0, 0.0, 60.0]


@pytest.mark.parametrize(("name", "damage", "subject", "found"), [
    ("weights", removed, "/weights", "nothing there"), ("control", value(np.zeros((2, 3, 4, 5))), "/control", "shape"),
    ("spacing", value(np.array([4.0, 0.0, 6.0])), "deformation", "spacing_mm"),
    ("weights", value(np.full((3, 2), np.nan)), "/weights", "NaN"),
    ("times", attribute("units", "mm"), "/times @units", "'mm'"), ("control", _folded, "deformation", "folds"),
])  # fmt: skip
def test_damage_is_named_in_one_line(path: Path, name: str, damage: Change, subject: str, found: str) -> None:
    on(f"{GROUP}/{name}", damage)(path)
    with pytest.raises(InputError) as caught:
        read_deformation(path)
    assert caught.value.subject.endswith(subject) and found in str(caught.value) and "\n" not in str(caught.value)


def a_moving_scan(make_scan: Callable[..., Scan]) -> Scan:
    states = np.random.default_rng(3).uniform(0, 1, (2, *make_scan().grid.shape)).astype(np.float32)
    field = Deformation(np.full((1, 2, 2, 2, 3), 0.1), (0.0, 0.0, 0.0), 4.0, np.array([0.0, 5.0]), np.array([[0.0], [1.0]]))
    return make_scan(reference=states[0], moving_truth=MovingTruth(np.array([1.0, 2.5]), states, field))


def test_a_scan_holds_states_and_how_they_came_about(tmp_path: Path, make_scan: Callable[..., Scan]) -> None:
    scan, path = a_moving_scan(make_scan), tmp_path / "scan.h5"
    write_scan(path, scan)
    again = read_scan(path, counts_to_attenuation).moving_truth
    np.testing.assert_array_equal(again.volumes, scan.moving_truth.volumes)
    np.testing.assert_array_equal(again.times_s, [1.0, 2.5])
    for field in (again.deformation, read_deformation(path)):
        np.testing.assert_array_equal(field.control_mm, scan.moving_truth.deformation.control_mm)
    assert scan_summary(path)["true_states"] == 2
    part = scan.on_grid(scan.grid.part((0, 1, 1), (2, 2, 2))).moving_truth
    np.testing.assert_array_equal(part.volumes, scan.moving_truth.volumes[:, :, 1:, 1:3])
    assert scan.on_grid(Grid.cube(3, 90.0)).moving_truth is None


def test_damaged_states_are_named(tmp_path, make_scan) -> None:
    write_scan(path := tmp_path / "scan.h5", a_moving_scan(make_scan))
    good, damages = path.read_bytes(), [(name, removed) for name in ("states", "state_times", "deformation/control")]
    for name, damage in (*damages, ("states", value(np.ones((3, 2, 3, 4)))), ("states", value(np.zeros((2, 2, 3, 4))))):
        path.write_bytes(good)
        on(f"/entry/phyradgs/reference/{name}", damage)(path)
        with pytest.raises(InputError) as caught:
            read_scan(path, counts_to_attenuation)
        assert caught.value.subject.endswith(f"reference/{name}")
