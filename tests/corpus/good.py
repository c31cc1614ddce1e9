"""The good files that the corpus damages: a fly-scan, raw counts, volumes, a scanner, a configuration, checkpoints."""

from pathlib import Path

import h5py
import numpy as np
from corpus import imports
from corpus.hdf5_damage import put

from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.io import checkpoint_path, write_checkpoint
from phyradgs_cl.reconstructors import Progress, reconstruct
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import read_settings
from phyradgs_cl.workflow.files import load_scan

SCANNER = """title = "a small one"
[source]
to_axis_mm = 500.0
to_detector_mm = 800.0
[detector]
rows = 8
columns = 9
pixel_size_v_mm = 3.0
pixel_size_u_mm = 2.5
offset_v_mm = 1.0
offset_u_mm = -2.0
lag = 0.05
[volume]
shape = [8, 7, 6]
size_mm = [14.0, 13.0, 12.0]
offset_mm = [1.0, 2.0, 3.0]
[readout]
axis = "rows"
direction = -1
ratio = 0.5
[beam]
pulse_start = 0.2
pulse_length = 0.9
"""
CONFIG = """method = "phyradgs"
preset = "paper"
motion = "micro-views"
strips = 2
sub_intervals = 2
iterations = 3
gaussians = 20
seed = 1
tv_weight = 0.02
[rates]
position = [2e-4, 2e-5]
[control]
every = 100
threshold = 5e-5
"""
RESUMED = {
    "sirt": ["--iterations", "6"],
    "cgls": ["--iterations", "6", "--set", "noise_stop=0"],
    "fista-tv": ["--iterations", "6"],
    "os-sart": ["--iterations", "6"],
    "phyradgs": ["--method", "phyradgs", "--iterations", "100", "--gaussians", "30", "--motion", "static"],
}


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
    (folder / "scanner.toml").write_text(SCANNER)
    (folder / "run.toml").write_text(CONFIG)
    imports.write_good(folder)
    for method in RESUMED:
        _write_checkpoint(folder, method)
    return folder


def resume_command(method: str) -> tuple[str, ...]:
    """A run that goes on from the checkpoint beside its output."""
    options = tuple(RESUMED[method])
    return ("reconstruct", "{good}/fly.h5", "--method", method, *options, "--resume", "-o", "{out}")


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


def _stop(progress: Progress) -> None:
    raise KeyboardInterrupt


def _write_checkpoint(folder: Path, method: str) -> None:
    """What an interrupted run of ``resume_command`` leaves."""
    scan = folder / "fly.h5"
    options = dict(zip(RESUMED[method][::2], RESUMED[method][1::2], strict=True))
    assignments = [options.pop("--set")] if "--set" in options else []
    given = {name.strip("-"): int(text) if text.isdigit() else text for name, text in options.items()}
    plan = read_settings(None, {"method": method, **given}, assignments).plan()
    result = reconstruct(load_scan(scan), plan, Runtime(), report=_stop)
    assert result.state is not None
    write_checkpoint(checkpoint_path(folder / method), result.state)
