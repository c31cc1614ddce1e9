"""Options and values of earlier versions that no longer exist, and what to write instead."""

from phyradgs_cl.errors import InputError

_UNWEIGHTED = [f"--method {of}: option transmission_weights" for of in ("sart", "os-sart", "sirt", "asd-pocs")]
REMOVED = {
    "--method fused": "take --method fista, or start Gaussians from its volume: --method phyradgs --initial VOLUME",
    "--method asd-pocs: option prior_share": "take --method fista --prior piccs",
    **dict.fromkeys(_UNWEIGHTED, "take --method fista or fista-tv, which keep it"),
    "phyradgs bench": "run 'make demo', or python benchmarks/tables, in the source (docs: benchmarks.md)",
    "phyradgs splat": "start Gaussians from a volume with 'phyradgs reconstruct SCAN --method phyradgs --initial VOLUME'",
    "phyradgs watch": "run examples/watch_folder.py of the source, which calls 'phyradgs reconstruct' for each scan",
    "--batch": "say --set batch=FRAMES",
    "--ignore-lag": "say --set ignore_lag=true",
    "--segments": "say --set segments=NUMBER",
    "--time-error": "say --set time_error=ERROR",
    "scheduler": "write --workers ADDRESS",
    "--motion own-times": "say --motion per-row, which is as exact; Python has OwnTimes()",
    "--motion static-start": "say --motion static, which takes the middle; Python has StaticStart()",
    "--preset released": "say --preset paper",
    "--prior curves": "say --prior ridge, the default, or dct",
    "pixel_footprint": "leave it out: pixels see splats at their centres, which gives 0.5 dB more",
    "fly_scan.first": "say readout and readout_direction; row 0 is the lowest, column 0 the left one",
    "fly_scan.fps": "say exposure_deg, degrees per second times exposure_s, and exposure_s",
    "fly_scan.readout_ms": "say readout_ratio, the readout over the exposure",
    "frame_time_s": "say --fps, frames per second",
    "median_filter": "use --steps sparks,dead, which mend odd pixels alone",
    "order": "leave it out: neighbours in time are far apart in every pass",
    "poisson_weight": "take transmission_weights of --method fista or fista-tv",
    "readout": "say --first, the side whose line is read first: top, bottom, left or right",
    "readout_direction": "say --first, the side whose line is read first: top, bottom, left or right",
    "readout_ratio": "say --fps and --readout-ms",
    "readout_s": "say --readout-ms",
    "rings.method": "leave it out: the pattern comes from the mean over views",
    "shape_floor": "use scale_min, the smallest scale",
    "shape_ratio": "use control.prune_aspect, which removes thin Gaussians",
    "shape_weight": "use control.prune_aspect, which removes thin Gaussians",
    "tune": "compare your own values of the option by --holdout 2",
    "--what lag": "state the panel's lag in the TOML of 'phyradgs import' (docs: formats.md)",
    "--what drift": "correct the frames by 'phyradgs prepare --steps air'",
    "--what start": "leave it out: another start only turns the object about the axis",
}
"""What to do instead of each removed word: an option, an option with its value, or a command. An option that other methods
still have is listed as ``--method NAME: option WORD``, for the method NAME that lost it."""


def removal(word: str, subject: str = "") -> InputError | None:
    """Returns the error that says what replaces ``word``, a former option or value in ``REMOVED``; None for other words.
    subject: the beginning of the error's message, such as ``--tune``; by default ``word``."""
    return InputError(subject or word, "a word of an earlier version", "", REMOVED[word]) if word in REMOVED else None


def refuse_removed(word: str, subject: str = "") -> None:
    """Raises an InputError that says what to write instead, for a word in ``REMOVED``."""
    if (error := removal(word, subject)) is not None:
        raise error
