"""Poses of single views by gradients through splats, compared with calibrate: python examples/own_poses.py"""

import numpy as np

import phyradgs_cl.api as phy

PASSES, BATCH, LOGS = 10, 6, [3, 4, 5, 10]
RATES = np.repeat([0.004, 0.03, 0.02, 0.03], [3, 3, 4, 1])[:, None]  # of mean (mm), log scale, quaternion, log density


def adam(values, gradient, moments, rate, step):
    """Returns new values and moments after one step of Adam."""
    first, second = moments[0] + 0.1 * (gradient - moments[0]), moments[1] + 0.01 * (gradient**2 - moments[1])
    move = first / (1 - 0.9**step) / (np.sqrt(second / (1 - 0.99**step)) + 1e-12)
    return values - rate * move, np.stack([first, second])


def refine(scan, pixels):
    """Fits Gaussians and views (F, 3) together; ``pixels`` (3,): turn and shifts that move a frame by about a pixel."""
    rng, raw, views = np.random.default_rng(0), phy.initial_gaussians(scan, 600).rows(), np.zeros((scan.frames, 3))
    raw[LOGS] = np.log(raw[LOGS])
    moments, of_views = np.zeros((2, *raw.shape)), np.zeros((2, *views.shape))
    units = pixels / (1, *scan.geometry.pixel_size_mm)
    for number in range(PASSES):
        slower = 0.05 ** (number / PASSES)
        for batch in rng.permutation(scan.frames).reshape(-1, BATCH):
            rows = raw.copy()
            rows[LOGS] = np.exp(raw[LOGS])
            S = phy.splat_operator(phy.move_views(scan, views, without_gauges=True)).frames(batch)
            frames, back = S.vjp(rows)
            residual = frames - scan.projections[batch]
            by_rows, by_views = back(residual), S.by_poses(rows, residual) * units
            by_rows[LOGS] *= rows[LOGS]
            raw, moments = adam(raw, by_rows, moments, slower * RATES, number * scan.frames // BATCH + 1)
            moments_now = of_views[:, batch]
            views[batch], of_views[:, batch] = adam(views[batch], by_views, moments_now, slower * 0.1 * pixels, number + 1)
    return views


if __name__ == "__main__":
    scan = phy.simulate("foot", size=16, detector=32, views=30, exposure_deg=6.0)
    pitch_mm = scan.geometry.pixel_size_mm[0]
    pixels = np.array([2 * pitch_mm / scan.grid.size_mm[0], pitch_mm, pitch_mm])
    wrong = np.random.default_rng(1).normal(size=(scan.frames, 3)) * pixels
    stated = phy.move_views(scan, wrong, without_gauges=True)
    found = phy.move_views(stated, refine(stated, pixels), without_gauges=True)
    scans = {"stated": stated, "found": found, "calibrated": phy.calibrate(stated, "wobble").scan, "right": scan}
    for name, one in scans.items():
        volume = phy.reconstruct(one, method="fista", motion="per-row", report=False).volume
        print(f"{name}: {phy.compare(volume, scan.reference)['psnr_db']:.2f} dB")
