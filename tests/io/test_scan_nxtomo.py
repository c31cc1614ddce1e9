"""A scan file as the nxtomo package, which set the layout, reads it; and the other way round."""

import h5py
import numpy as np
import pint
import pytest
from damage import attribute, on

from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.io import read_scan, write_scan

pytestmark = pytest.mark.slow


@pytest.fixture
def nxtomo():
    from nxtomo.application import nxtomo  # takes seconds, in every process that collects tests

    return nxtomo


def test_nxtomo_reads_our_file_whose_default_plot_leads_to_the_frames(nxtomo, tmp_path, make_scan) -> None:
    scan, path, key = make_scan(), tmp_path / "scan.nx", np.array([2, 1, 0, 0, 0, 1, 0])
    data = np.full((7, 3, 5), 60000, np.uint16)
    data[0] = 100
    data[key == 0] = np.round(100 + 59900 * np.exp(-scan.projections))
    write_scan(path, scan, data=data, image_key=key, quantity="counts")
    assert nxtomo.NXtomo.get_valid_entries(str(path)) == ("/entry",)
    tomo = nxtomo.NXtomo().load(str(path), "/entry", detector_data_as="as_numpy_array")
    detector = tomo.instrument.detector
    np.testing.assert_array_equal(detector.data, data)
    np.testing.assert_array_equal([int(k.value) for k in detector.image_key_control], key)
    lengths = detector.x_pixel_size, detector.y_pixel_size, detector.distance, tomo.instrument.source.distance
    assert [one.to("mm").magnitude for one in lengths] == pytest.approx([0.5, 0.6, 1200.0 - 785.0, -785.0])
    assert detector.count_time.to("s").magnitude == pytest.approx(0.8)
    angles_deg = tomo.sample.rotation_angle.to("degree").magnitude
    np.testing.assert_allclose(angles_deg, [10, 10, 10, 25, 40, 40, 58])
    assert tomo.title == "a test scan" and tomo.sample.name == "a test scan"
    with h5py.File(path) as file:
        entry = file[file.attrs["default"]]
        group = entry[entry.attrs["default"]]
        assert entry.attrs["NX_class"] == "NXentry" and group.attrs["NX_class"] == "NXdata"
        np.testing.assert_array_equal(group[group.attrs["signal"]], data)
        assert all(name == "." or name in group for name in group.attrs["axes"])


def test_we_read_a_file_of_nxtomo(nxtomo, tmp_path) -> None:
    """A static cone-beam file without our own group: angles are the sample's, distances in metres."""
    units, rng = pint.get_application_registry(), np.random.default_rng(3)
    tomo = nxtomo.NXtomo()
    tomo.title = "theirs"
    tomo.instrument.detector.data = rng.uniform(0.1, 2, (5, 4, 6)).astype(np.float32)
    tomo.instrument.detector.image_key_control = np.zeros(5, int)
    tomo.instrument.detector.x_pixel_size = 0.2 * units.mm
    tomo.instrument.detector.y_pixel_size = 0.3 * units.mm
    tomo.instrument.detector.distance = 0.25 * units.m
    tomo.instrument.detector.count_time = np.full(5, 0.1) * units.s
    tomo.instrument.source.distance = -0.5 * units.m
    tomo.sample.rotation_angle = np.linspace(0, 144, 5) * units.degree
    tomo.save(str(tmp_path / "theirs.nx"), "entry0000")
    on("entry0000/instrument/detector/data", attribute("quantity", "attenuation"))(tmp_path / "theirs.nx")
    scan = read_scan(tmp_path / "theirs.nx", counts_to_attenuation)
    assert not scan.is_fly and scan.title == "theirs"
    found = scan.geometry.source_to_axis_mm, scan.geometry.source_to_detector_mm, *scan.geometry.pixel_size_mm
    assert found == pytest.approx((500, 750, 0.3, 0.2)) and scan.shutter.exposure_s == pytest.approx(0.1)
    np.testing.assert_array_equal(scan.projections, tomo.instrument.detector.data)
    assert np.rad2deg(scan.trajectory.angle_rad(2, scan.frame_start_s[2:3]))[0] == pytest.approx(-72)
