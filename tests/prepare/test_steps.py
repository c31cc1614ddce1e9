"""Steps on a fly-scan with effects planted, and what they are made of; each step by itself: test_each_step.py."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import compare, reconstruct, simulate
from phyradgs_cl.detector import tube_spectrum
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare import (
    PREPARED_KEY,
    STEPS,
    Model,
    fit_scatter,
    remove_scatter,
    straighten,
    water_polynomial,
)
from phyradgs_cl.prepare.hardening import find_bone
from phyradgs_cl.prepare.scatter import raised
from phyradgs_cl.reconstructors import Preprocessing, preprocessing_of
from phyradgs_cl.reconstructors.preprocess import prepared, reprojection

pytestmark = pytest.mark.slow


def psnr_db(rt, scan: Scan, steps: str = "", **options: object) -> float:
    volume = reconstruct(scan, "fdk", motion="per-row", steps=steps, device=rt, **options).volume
    return float(compare(volume, scan.reference)["psnr_db"])


def test_steps_that_reconstruct_take_parallel_beams(rt) -> None:
    """By FBP: FDK refused them."""
    scan = simulate("foot", size=16, detector=24, views=20, protocol="static", scanner="parallel", kvp=120.0, device=rt)
    made = prepared(scan, preprocessing_of({"steps": "hardening", "hardening": {"kvp": 120.0}}), rt)
    assert np.isfinite(made.projections).all() and not np.array_equal(made.projections, scan.projections)


def test_what_is_bone_may_be_stated(rt, planted) -> None:
    """The half of the largest attenuation that the simulation takes; where nothing is as dense, all is water."""
    clean, spoilt = planted(), planted(kvp=120.0)
    half = 0.5 * float(clean.reference.max())
    before, lost = psnr_db(rt, spoilt), psnr_db(rt, clean) - psnr_db(rt, spoilt)
    stated = psnr_db(rt, spoilt, "hardening", hardening={"kvp": 120.0, "bone_per_mm": half})
    assert stated - before > 0.6 * lost
    none = prepared(spoilt, preprocessing_of({"steps": "hardening", "hardening": {"kvp": 120.0, "bone_per_mm": 99.0}}), rt)
    np.testing.assert_array_equal(none.projections, straighten(spoilt.projections, water_polynomial(120.0)))


def test_scatter_and_polynomials_in_closed_form() -> None:
    p = np.zeros((2, 40, 60), np.float32)
    p[:, 10:30, 20:40] = 2.0
    clean = remove_scatter(p, {(0.2, 1): 0.5})
    assert (clean[:, 12:28, 22:38] > 2.05).all() and (clean >= p - 1e-6).all()
    np.testing.assert_array_equal(remove_scatter(p, {}), p)
    np.testing.assert_allclose(straighten(np.array([2.0, -1.0]), (0.5, 0.25, 0.0)), [2 + 2 + 2, -1])
    water = np.linspace(0.1, 6, 50)
    seen = tube_spectrum(120.0).hardened(water)
    assert (seen < water).all() and seen[-1] < 0.95 * water[-1]
    np.testing.assert_allclose(straighten(seen, water_polynomial(120.0)), water, rtol=2e-3)


def test_scatter_is_told_from_light_that_drifts() -> None:
    """Thick rays that scatter otherwise than thin ones; every frame lighter or darker, by 3 % at most."""
    v, u = np.mgrid[-20:20, -30:30]
    p = np.stack([np.maximum(2 * np.exp(-(v**2 / (60 + 8 * f) + u**2 / (200 - 12 * f))) - 0.05, 0) for f in range(9)])
    planted = {(0.18, 1): 0.1, (0.18, 2): 0.2}
    lost = sum(height * np.exp(-p) * p**power for (_, power), height in planted.items())
    scattered = -np.log(np.exp(-p) + gaussian_filter(lost, (0, 10.8, 10.8), mode="constant"))
    light = 1 + np.array([0.03, -0.02, 0.01, -0.03, 0.0, 0.02, -0.01, 0.03, -0.03])[:, None, None]
    kernel = fit_scatter((scattered - np.log(light)).astype(np.float32), p == 0)
    left = remove_scatter(scattered, kernel) - p
    assert np.abs(left).max() < 1e-3 * np.abs(scattered - p).max(), kernel


def _exact_model(shape: tuple[int, int, int], rays: tuple[int, int, int]) -> Model:
    """Random rays, more than voxels, the first column's through nothing, and their least squares: what no grid spoils."""
    along = np.random.default_rng(3).random((*rays, np.prod(shape))) ** 4 / 20
    along[:, :, 0] = 0
    along = along.reshape(np.prod(rays), -1)
    back = np.linalg.pinv(along)

    def volume(frames: np.ndarray) -> np.ndarray:
        return (back @ frames.ravel()).reshape(shape).astype(np.float32)

    return Model(volume, lambda v: (along @ v.ravel()).reshape(rays).astype(np.float32), volume, lambda inside: inside)


def test_a_kernel_is_raised_to_what_frames_say() -> None:
    """From half its height to nearly all of it; the right one stays."""
    volume = np.random.default_rng(4).random((6, 6, 6)).astype(np.float32)
    model = _exact_model(volume.shape, (8, 9, 9))
    frames = model.frames(volume)
    frames *= 2 / frames.max()
    lost = np.exp(-frames) * frames
    scattered = -np.log(np.exp(-frames) + 0.8 * gaussian_filter(lost, (0, 2.7, 2.7), mode="constant"))
    air, half, right = frames == 0, {(0.3, 1): 0.4}, {(0.3, 1): 0.8}
    (height,) = raised(half, scattered, air, model).values()
    assert 0.6 < height < 1.0 and raised(right, scattered, air, model) == right
    assert raised({}, scattered, air, model) == {}


def test_bone_is_what_the_beam_says_and_not_the_densest_of_three_classes() -> None:
    """Soft tissue, a skull of which the beam knows nothing, teeth; and frames that do not bend are left as they are."""
    volume = np.full((6, 6, 6), 0.2, np.float32)
    volume[:, 1], volume[2:4, 2:4, 2:4] = 0.5, 1.5
    model, spectrum, water = _exact_model(volume.shape, (8, 9, 9)), tube_spectrum(120.0), water_polynomial(120.0)
    soft, teeth = model.frames(volume * (volume < 1)), model.frames(volume * (volume > 1))
    bent = spectrum.hardened(soft, teeth).astype(np.float32)
    mixed, unexplained = find_bone(bent, spectrum, water, model)
    assert mixed is not None and 0.3 <= mixed[0] < mixed[1], (mixed, unexplained)
    assert unexplained["bone"] < 0.5 * unexplained["water"] < 0.5 * unexplained["as_they_are"], unexplained
    assert find_bone(soft + teeth, spectrum, water, model)[0] is None
    only_soft = spectrum.hardened(soft + teeth).astype(np.float32)
    assert find_bone(only_soft, spectrum, water, model)[0] == (np.inf, np.inf)


def test_one_material_says_its_own_polynomial(rt, planted) -> None:
    """A ball of water: its path through the volume tells how line integrals bend; an object of many is refused."""
    scan = simulate("spheres", size=20, detector=30, views=30, exposure_deg=9.0, peak=4.0, device=rt)
    z, y, x = np.mgrid[:20, :20, :20] - 9.5
    ball = (x**2 + y**2 + z**2 < 56).astype(np.float32)
    true = reprojection(rt, scan).frames(ball)
    true *= 5 / true.max()
    straight = replace(scan, projections=true, reference=None)
    bent = replace(straight, projections=tube_spectrum(120.0).hardened(true).astype(np.float32))
    found = prepared(bent, Preprocessing(steps="hardening"), rt).projections
    error, before = (np.sqrt(np.mean((f - true) ** 2)) for f in (found, bent.projections))
    assert error < 0.7 * before, (error, before)
    with pytest.raises(InputError, match="hardening.kvp"):
        prepared(planted(kvp=120.0), Preprocessing(steps="hardening"), rt)


def test_all_effects_together(rt, planted) -> None:
    effects = {"sparks": 1e-3, "rings": 0.02, "drift": 0.02, "scatter": 0.3, "kvp": 120.0}
    steps = "rings,hardening,air,scatter,sparks"
    clean, spoilt = psnr_db(rt, planted()), psnr_db(rt, planted(**effects))
    found = psnr_db(rt, planted(**effects), steps, hardening={"kvp": 120.0})
    assert found - spoilt > 0.5 * (clean - spoilt), (clean, spoilt, found)


def test_steps_keep_their_order_and_are_told(rt, planted) -> None:
    result = reconstruct(planted(), "fdk", steps="rings, sparks", rings={"window": 5}, device=rt)
    told = result.facts[PREPARED_KEY]
    assert [line["step"] for line in told] == ["sparks", "rings"] and told[1]["options"]["window"] == 5
    again = prepared(prepared(planted(), Preprocessing(steps="sparks")), Preprocessing(steps="rings"))
    assert [line["step"] for line in again.provenance[PREPARED_KEY]] == ["sparks", "rings"]
    facts = preprocessing_of({"steps": "rings", "rings": {"window": 5}}).facts()
    assert preprocessing_of(facts) == Preprocessing(steps="rings", rings=replace(Preprocessing().rings, window=5))


def test_what_is_no_step_or_no_option_of_one(rt, planted) -> None:
    empty, falling = replace(planted(), projections=0 * planted().projections), {"polynomial": [-5, 0, 0]}
    full = replace(planted(), projections=planted().projections + 1)
    straight = replace(planted(), provenance={**planted().provenance, PREPARED_KEY: [{"step": "hardening"}]})
    cases = (
        (lambda: preprocessing_of({"steps": "rings", "rings": {"window": 1}}), "rings.window: found 1"),
        (lambda: prepared(planted(), preprocessing_of({"steps": "rings", "rings": {"window": 99}}), rt), "rings.window"),
        (lambda: prepared(empty, preprocessing_of({"steps": "hardening", "hardening": {"kvp": 80}}), rt), "nothing"),
        (lambda: prepared(planted(), preprocessing_of({"steps": "hardening", "hardening": falling}), rt), "falls"),
        (lambda: preprocessing_of({"steps": "hardening", "hardening": {"bone_per_mm": 0.1}}), "without hardening.kvp"),
        (lambda: preprocessing_of({"steps": "hardening", "hardening": {"kvp": 5}}), "hardening.kvp"),
        (lambda: preprocessing_of({"steps": "hardening", "hardening": {"kvp": 80, "polynomial": [1, 0, 0]}}), "one of the"),
        (lambda: prepared(full, Preprocessing(steps="hardening")), "without a device"),
        (lambda: prepared(straight, Preprocessing(steps="sparks,hardening"), rt), "hardening, which this scan has had"),
    )
    for call, told in cases:
        with pytest.raises(InputError, match=told):
            call()
    assert set(STEPS) <= set(vars(Preprocessing()))
