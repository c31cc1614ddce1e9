"""The good files that the corpus damages: a fly-scan, raw counts, a volume with Gaussians, a bare volume."""

from pathlib import Path

import h5py
import numpy as np
from corpus.hdf5_damage import put

from phyradgs_cl.__main__ import load_cli


def write_good(folder: Path, seed: int = 0) -> Path:
    """All good files in ``folder``, which is new; the same for the same seed."""
    folder.mkdir(parents=True)
    cli = load_cli()
    simulate = ["simulate", "--phantom", "jaw", "--size", "8", "--detector", "12", "--views", "4"]
    simulate += ["--time-samples", "2", "--jitter-deg", "0.1", "--seed", str(seed)]
    assert cli.run([*simulate, "-o", str(folder / "fly.h5")]) == 0
    _write_counts(folder / "counts.h5", folder / "fly.h5", np.random.default_rng(seed))
    tiny = ["--method", "phyradgs", "--iterations", "3", "--gaussians", "20", "--motion", "static"]
    assert cli.run(["reconstruct", str(folder / "fly.h5"), *tiny, "-o", str(folder / "volume.h5")]) == 0
    with h5py.File(folder / "bare.h5", "w") as file:
        file["volume"] = np.random.default_rng(seed).integers(0, 255, (5, 6, 7), np.uint8)
    return folder


def _write_counts(path: Path, fly: Path, rng: np.random.Generator) -> None:
    """The same scan as raw counts with flats, darks, an invalid frame, a mask, a pulse, a lag and end angles."""
    path.write_bytes(fly.read_bytes())
    detector = "entry/instrument/detector"
    key = np.array([2, 1, 0, 0, 3, 0, 0, 1], np.int32)
    with h5py.File(path, "r+") as file:
        frames = file[f"{detector}/data"][()]
        data = np.full((8, *frames.shape[1:]), 100, np.uint16)
        data[key == 1] = 60_000
        data[key == 0] = (60_000 * np.exp(-frames)).astype(np.uint16) + rng.integers(0, 9, frames.shape)
        rows = np.clip(np.cumsum(key == 0) - 1, 0, None)
        starts, angles = f"{detector}/frame_start_time", ("rotation_angle", "rotation_angle_end")
        for name in (starts, *(f"entry/sample/{angle}" for angle in angles)):
            put(file, name, file[name][()][rows])
        del file["entry/phyradgs/kinematics"]
        put(file, f"{detector}/data", data)
        file[f"{detector}/data"].attrs["quantity"] = "counts"
        put(file, f"{detector}/image_key", key)
        mask = np.zeros(frames.shape[1:], np.uint8)
        mask[0, 0] = 1
        file[f"{detector}/pixel_mask"] = mask
        extra = file["entry/phyradgs"]
        for name, value, unit in (("pulse_start", 0.01, "s"), ("pulse_length", 1e3, "s"), ("lag", 0.02, "")):
            extra[name] = value
            if unit:
                extra[name].attrs["units"] = unit
