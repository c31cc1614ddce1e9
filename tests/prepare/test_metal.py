"""Two steel beads in water under a tube's spectrum: streaks go, the beads come back, and scans without metal stay."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from phyradgs_cl import api
from phyradgs_cl.acquisition import Scan, pixel_centres
from phyradgs_cl.detector import tube_spectrum
from phyradgs_cl.detector.attenuation import _WATER, _at
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

pytestmark = pytest.mark.slow
GRID = Grid((32, 32, 32), (3.75, 3.75, 3.75))
IRON = ((30, 8.176), (40, 3.629), (50, 1.958), (60, 1.205), (80, 0.5952), (100, 0.3717), (150, 0.1964))  # cm²/g, NIST
BODY = [Ellipsoid((0, 0, 0), (45, 36, 48), 1.0), Ellipsoid((-12, -14, 4), (9, 9, 9), -0.4)]
BALL = "{centre_mm = [0.0, 0.0, 0.0], radius_mm = 0.9, attenuation_per_mm = 0.2}"
BALL_OF_STEEL = "{{centre_mm = [{}, 0.1, 0.1], radius_mm = 0.15, attenuation_per_mm = 4.0}}"
STEEL = [Ellipsoid((24, -4, 0), (5, 5, 5), 1.0), Ellipsoid((-20, 10, 2), (5, 5, 5), 1.0)]


@pytest.fixture(scope="module")
def beads(rt):
    """(with the beads) → a stop-and-shoot scan of 45 views at 120 kV, its truth that of the water."""

    @cache
    def make(has_steel: bool) -> Scan:
        cone = api.ConeGeometry(785.0, 1200.0, (48, 48), 4.4)
        empty = api.static_scan(np.zeros((45, 48, 48), np.float32), cone, np.arange(45) * 8.0, grid=GRID)
        spectrum = tube_spectrum(120.0)
        energies, iron = np.log(np.array(IRON).T)
        water = _at(spectrum.energy_kev, _WATER) / 10
        steel = np.exp(np.interp(np.log(spectrum.energy_kev), energies, iron)) * 7.87 / 10
        paths, light = [_paths(empty, bodies) for bodies in (BODY, STEEL)], np.zeros(empty.projections.shape)
        for weight, soft, dense in zip(spectrum.weight, water, steel, strict=True):
            light += weight * np.exp(-soft * (paths[0] - paths[1] * has_steel) - dense * paths[1] * has_steel)
        counts = np.random.default_rng(1).poisson(2e5 * light)
        truth = EllipsoidPhantom(tuple(BODY), "body").voxelise(GRID, 3) * float(spectrum.weight @ water)
        return replace(empty, projections=-np.log(np.maximum(counts, 1) / 2e5).astype(np.float32), reference=truth)

    return make


def _paths(scan: Scan, bodies: list[Ellipsoid]) -> np.ndarray:
    """(F, v, u) float64 mm through the bodies, three by three rays to a pixel."""
    poses = np.stack([scan.trajectory.pose(f, np.array(t)) for f, t in enumerate(scan.frame_start_s)])
    centres = pixel_centres(poses, (48, 48))
    steps = [poses[:, None, None, 6:9] * a + poses[:, None, None, 9:12] * b for a in (-1, 0, 1) for b in (-1, 0, 1)]
    phantom = EllipsoidPhantom(tuple(bodies), "bodies")
    return sum(phantom.line_integrals(poses[:, None, None, :3], centres + step / 3) for step in steps) / 9


@pytest.mark.parametrize(("method", "share"), [("fdk", 0.5), ("fista", 0.15)])
def test_most_of_the_streaks_go_and_the_beads_are_put_back(rt, beads, method, share) -> None:
    inside = binary_dilation(EllipsoidPhantom(tuple(STEEL), "steel").voxelise(GRID, 3) > 0.02, iterations=2)
    options = {} if method == "fdk" else {"iterations": 6}
    spoilt, without = beads(True), beads(False)
    mended = api.prepare(spoilt, "metal", device=rt)
    volumes = [api.reconstruct(scan, method, device=rt, **options).volume for scan in (without, spoilt, mended)]
    before, after = (float(np.mean((volume - volumes[0])[~inside] ** 2)) for volume in volumes[1:])
    assert after < share * before, (before, after)
    truth = np.where(inside, 0, spoilt.reference)
    spoilt_db, mended_db = (api.compare(np.where(inside, 0, volume), truth)["psnr_db"] for volume in volumes[1:])
    assert mended_db > spoilt_db
    is_metal = mended.metal.values > 0
    assert is_metal.any() and (volumes[2][is_metal] == mended.metal.values[is_metal]).all()
    assert volumes[2].max() > 6 * np.median(volumes[0][volumes[0] > 0.01])
    ring = binary_dilation(is_metal, iterations=2) & ~is_metal
    if method == "fdk":  # voxels that only masked rays meet stayed near 0, and so did what filled the shadow
        assert volumes[2][ring].mean() == pytest.approx(volumes[0][ring].mean(), rel=0.15)


def test_the_shadow_is_masked_and_the_rest_stays_bit_for_bit(rt, beads, tmp_path) -> None:
    spoilt = beads(True)
    mended = api.prepare(spoilt, "metal", device=rt)
    shadow = ~mended.valid
    assert 0.005 < shadow.mean() < 0.15 and not shadow.all(axis=(1, 2)).any()
    assert shadow[_paths(spoilt, STEEL) > 0].all()
    np.testing.assert_array_equal(mended.projections[~shadow], spoilt.projections[~shadow])
    off, metal = (one.projections - beads(False).projections for one in (mended, spoilt))
    assert np.mean(off[shadow] ** 2) < 0.05**2 * np.mean(metal[shadow] ** 2)
    api.save_scan(tmp_path / "s.h5", mended)
    again = api.load_scan(tmp_path / "s.h5")
    np.testing.assert_array_equal(again.metal.values, mended.metal.values)
    assert again.metal.grid == mended.metal.grid
    fine = api.reconstruct(again, "fdk", size=48, device=rt).volume
    assert fine.shape == (48, 48, 48) and fine.max() == pytest.approx(mended.metal.values.max(), rel=0.2)


def test_a_scan_without_metal_stays_bit_for_bit(rt, beads, planted, closed_form) -> None:
    for scan in (beads(False), planted(kvp=120.0), closed_form("skull")):
        mended = api.prepare(scan, "metal", device=rt)
        assert mended.projections is scan.projections and mended.metal is None and mended.valid.all()
        assert mended.provenance["prepared"][-1]["result"] == "nothing to do"


def test_every_time_of_an_exposure_is_in_the_shadow(rt, tmp_path) -> None:
    """A bead far from the axis moves over several pixels while a frame is open: all that it darkens is masked."""
    scans = []
    for name, bodies in {"body.toml": BALL, "bead.toml": f"{BALL}, {BALL_OF_STEEL.format(0.6)}"}.items():
        (tmp_path / name).write_text(f"bead = [{bodies}]\n")
        scans.append(api.simulate(tmp_path / name, size=24, detector=36, views=30, exposure_deg=12.0, device=rt))
    mended = api.prepare(scans[1], "metal", metal={"above_per_mm": 1.3}, device=rt)
    of_bead = scans[1].projections - scans[0].projections
    dark = of_bead > 0.02 * of_bead.max()
    assert dark.mean() > 0.01 and (~mended.valid)[dark].all() and (~mended.valid).mean() < 8 * dark.mean()


def test_a_threshold_is_believed_or_refused(rt, beads) -> None:
    spoilt = beads(True)
    stated = api.prepare(spoilt, "metal", metal={"above_per_mm": 0.2}, device=rt)
    assert stated.provenance["prepared"][-1]["above_per_mm"] == 0.2
    high = api.prepare(spoilt, "metal", metal={"above_per_mm": 50.0}, device=rt)
    assert high.projections is spoilt.projections and high.provenance["prepared"][-1]["result"] == "nothing to do"
    for above_per_mm, told in ((0.005, "whose shadow covers .* % of the object"), (-1.0, "metal.above_per_mm")):
        with pytest.raises(InputError, match=told):
            api.prepare(spoilt, "metal", metal={"above_per_mm": above_per_mm}, device=rt)


@pytest.fixture(scope="module")
def mended(rt, tmp_path_factory) -> Scan:
    (toml := tmp_path_factory.mktemp("bead") / "bead.toml").write_text(f"bead = [{BALL}, {BALL_OF_STEEL.format(0.5)}]\n")
    return api.prepare(api.simulate(toml, size=16, detector=24, views=20, exposure_deg=6.0, device=rt), "metal", device=rt)


@pytest.mark.parametrize("method", ["fista", "phyradgs", "changing", "moving"])
def test_what_fills_the_shadow_does_not_reach_iterative_methods_and_they_resume(rt, mended, caplog, method) -> None:
    """Splats too, whose first cloud is of FDK: here both start from one volume."""
    refilled = np.where(mended.valid, mended.projections, mended.projections + np.float32(0.5))
    options = {"iterations": 2, "holdout": 5.0, "device": rt}
    if method == "phyradgs":
        options |= {"iterations": 5, "initial": api.reconstruct(mended, "fdk", device=rt)}
    scans = mended, replace(mended, projections=refilled)
    whole, other = (api.reconstruct(one, method, report=False, **options) for one in scans)
    np.testing.assert_array_equal(whole.volume, other.volume)
    is_metal = mended.metal.values > 0
    assert (whole.volume[is_metal] == mended.metal.values[is_metal]).all() and "held_out" in whole.facts
    assert ("as in an object at rest" in caplog.text) == (method == "moving")
    if whole.states is not None:
        assert (whole.states.volumes[:, is_metal] == mended.metal.values[is_metal]).all()
    if method != "fista":
        return

    def stop(progress: api.Progress) -> None:
        if progress.iteration < options["iterations"]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as ended:
        api.reconstruct(mended, method, report=stop, **options)
    resumed = api.reconstruct(mended, method, report=False, resume=ended.value.partial, **options)
    np.testing.assert_array_equal(resumed.volume, whole.volume)
