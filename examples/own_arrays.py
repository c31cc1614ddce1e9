"""From NumPy arrays to a volume: counts of a fly-scan with flats and darks, reconstructed with and without its motion."""

import numpy as np

from phyradgs_cl.api import ConeGeometry, Reconstruction, compare, fly_scan, reconstruct, save_scan

# --- your arrays: here counts of two balls, from a gantry that never stops
VIEWS, ROWS, COLUMNS, PIXEL_MM = 30, 32, 48, 4.0
TO_AXIS_MM, TO_DETECTOR_MM = 500.0, 800.0
ARC_DEG, READOUT = 12.0, 0.86  # arc of an exposure; readout over exposure time
BALLS = [((18.0, 6.0, 4.0), 14.0, 0.02), ((-15.0, -20.0, -8.0), 10.0, 0.03)]  # centre x y z, radius, 1/mm
angles_deg = np.arange(VIEWS) * 360 / VIEWS


def line_integrals(turn_deg: np.ndarray) -> np.ndarray:
    """Returns line integrals (rows, columns) of the balls, with one gantry angle (rows,) for each row."""
    turn = np.deg2rad(turn_deg)[:, None]
    v_mm, u_mm = ((np.arange(n) - (n - 1) / 2) * PIXEL_MM for n in (ROWS, COLUMNS))
    picture = np.zeros((ROWS, COLUMNS))
    for (x, y, z), radius_mm, per_mm in BALLS:  # in a frame that turns with the gantry
        along, across = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
        to_ball = np.stack(np.broadcast_arrays(along - TO_AXIS_MM, across, z), -1)
        ray = np.stack(np.broadcast_arrays(-TO_DETECTOR_MM, u_mm, v_mm[:, None]), -1)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        off_mm2 = (to_ball**2).sum(-1) - (to_ball * ray).sum(-1) ** 2
        picture += 2 * per_mm * np.sqrt(np.clip(radius_mm**2 - off_mm2, 0, None))
    return picture


late = READOUT * np.arange(ROWS) / (ROWS - 1)  # delay of each row in exposures: row 0 is read first
times = (np.arange(9) + 0.5) / 9
frames = [np.mean([line_integrals(a + ARC_DEG * (late + t)) for t in times], 0) for a in angles_deg]
rng = np.random.default_rng(0)
counts = rng.poisson(200 + 30_000 * np.exp(-np.array(frames))).astype(np.uint16)
flats = rng.poisson(30_200, (10, ROWS, COLUMNS))
darks = rng.poisson(200, (10, ROWS, COLUMNS))

# --- five lines to the volume
cone = ConeGeometry(TO_AXIS_MM, TO_DETECTOR_MM, (ROWS, COLUMNS), (PIXEL_MM, PIXEL_MM))
motion = {"exposure_deg": ARC_DEG, "readout_ratio": READOUT, "readout": "rows"}
scan = fly_scan(counts, cone, angles_deg, **motion, flats=flats, darks=darks)
moving = reconstruct(scan, "fista-tv", motion="per-row", iterations=30)
moving.plot(scan).savefig("own_arrays.png")

# --- how much the known motion gains
save_scan("own_arrays.h5", scan)
still = reconstruct(scan, "fista-tv", motion="static", iterations=30)
z, y, x = np.meshgrid(*scan.grid.axes_mm(), indexing="ij")
truth = sum(mu * (np.hypot(np.hypot(x - a, y - b), z - c) < r) for (a, b, c), r, mu in BALLS)
for name, result in {"still": still, "moving": moving}.items():
    assert isinstance(result, Reconstruction)
    print(f"{name}: {compare(result.volume, truth)['psnr_db']:.2f} dB, {result}")
