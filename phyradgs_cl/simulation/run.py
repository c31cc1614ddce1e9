"""Simulates a scan from an object and an acquisition: each detector line averages over its own time window. Options that are
not stated have the scanner's values."""

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import __version__, checks, resource
from phyradgs_cl.acquisition import Protocol, Scan, make_protocol
from phyradgs_cl.acquisition.cells import per_line_cells, static_cells
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.acquisition.readout import check_readout, readout_order
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS, LARGEST_LAG
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.checks import option
from phyradgs_cl.detector import effects, tube_spectrum
from phyradgs_cl.detector.attenuation import HIGHEST_KVP, LOWEST_KVP
from phyradgs_cl.errors import InputError, NumericalError
from phyradgs_cl.fields import Gating, Grid, MovingTruth
from phyradgs_cl.io import Scanner, Volume, load_scanner, with_detector_count
from phyradgs_cl.phantoms import EllipsoidPhantom, MovingPhantom
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation.object_motion import ObjectMotion, load_object_motion
from phyradgs_cl.simulation.scenes import Scene, phantom_scene, volume_scene
from phyradgs_cl.simulation.sources import FrameSource
from phyradgs_cl.text import flag_of

_LARGEST_GRID = 4096  # limit of --size, in voxels along the longest side
_SMALLEST_PHANTOM = 2  # fewest voxels along a phantom's side: a procedural phantom is drawn on twice as many, and needs 4
_STATES = 8  # number of true volumes that are stored of a phantom whose parts move, over one period
log = logging.getLogger(__name__)
_PEAK = "Largest line integral, by scaling the attenuation; 0: unscaled."
_NOISE = "tigre: TIGRE's rescaled Poisson; beer: Beer-Lambert counts."
_ELECTRONIC = "Standard deviation of electronic noise, counts."
_JITTER = "Wander of the gantry (std, degrees), in the encoder table."
_MOTION = "TOML file of how the object moves: breathing, drying or sliding; the truth of some states is stored."
# Limits of options, far beyond any scanner, yet far from an overflow of float32 or of a random sampler.
_LARGEST_PEAK = 1e4  # limit of --peak, a line integral
_LARGEST_NOISE = 1e9  # limit of --electronic-noise, in counts
_SMALLEST_DOSE, _LARGEST_DOSE = 1e-3, 1e12  # limits of --dose, in photons per pixel
_LARGEST_DETECTOR = 32_000  # limit of --detector, in pixels along a side of the panel
_SLACK = 1.001  # a warning is logged if (arc of an exposure)/(turn between frames) exceeds this: 1, and 0.001 for rounding
_TIMING = ("views", "exposure_deg", "readout_ratio", "start_deg", "pulse", "turns")  # options that change the protocol
_DATA_SHEET = ("first", "fps", "readout_ms")  # options in a data sheet's terms: first line read, frames/s, readout time


@dataclass(frozen=True)
class SimulationOptions:
    """Options of a simulation. ``peak`` > 0 scales attenuation so that the largest line integral is ``peak``.

    - time_samples: at how many times a line's exposure is sampled, in the middles of equal parts. 0 takes 8 to 128 times, so
      that the volume's edge, and a moving object, go at most half a voxel from time to time (docs/mathematics.md).
    - dose: photons that a pixel without an object in front receives in a frame, on the line that sees light longest.
    - lag (λ), rings, sparks, drift, scatter: effects of panel and tube (detector/effects.py); 0 leaves an effect out.
    - kvp: tube voltage in kV of a beam that hardens; 0 means a beam of one energy.
    - motion_of_object: how the object moves during the scan; None means that it rests."""

    protocol: Protocol = Protocol()
    readout_axis: str = "rows"
    readout_direction: int = 1
    detector_model: str = option("log", "An exposure averages line integrals (log) or intensity.", words=DETECTOR_MODELS)
    peak: float = option(0.0, _PEAK, range=(0, _LARGEST_PEAK))
    noise: str = option("none", _NOISE, words=("none", "tigre", "beer"))
    dose: float = option(1e4, "Photons per pixel without object.", "10000", range=(_SMALLEST_DOSE, _LARGEST_DOSE))
    electronic_noise: float = option(10.0, _ELECTRONIC, "10", range=(0, _LARGEST_NOISE))
    jitter_deg: float = option(0.0, _JITTER, "0", range=(0, 360))
    lag: float = option(0.0, "Fraction of a frame's signal from the frames before.", "scanner's: 0", range=(0, LARGEST_LAG))
    time_samples: int = option(0, "Times of a line's exposure; 0: by the motion.", range=(0, 10_000))
    seed: int = option(0, "Seed of phantom, noise and jitter.", range=(0, 2**63))
    rings: float = option(0.0, "Spread of the pixels' gains (std), seen as rings.", "0", range=(0, 0.5))
    sparks: float = option(0.0, "Fraction of all pixels that a spark hits.", "0", range=(0, 0.1))
    drift: float = option(0.0, "Largest change of the tube's light from frame to flat.", "0", range=(0, 0.5))
    scatter: float = option(0.0, "Scatter over primary light behind the object.", "0", range=(0, 10))
    kvp: float = option(0.0, "Tube voltage, kV: a beam that hardens.", "0: one energy")
    motion_of_object: ObjectMotion | None = option(None, _MOTION, True)

    def __post_init__(self) -> None:
        checks.fields_within(flag_of, self)
        if not isinstance(self.motion_of_object, ObjectMotion | None):
            expected = "an ObjectMotion, or the path of a TOML file"
            raise InputError("--motion-of-object", checks.short_repr(self.motion_of_object), expected)
        if self.kvp != 0:
            checks.within("--kvp (kV)", self.kvp, LOWEST_KVP, HIGHEST_KVP)


OPTION_NAMES = frozenset({f.name for f in fields(SimulationOptions)} - {"protocol"}).union(_TIMING, _DATA_SHEET)
"""The names that ``scanner_options`` takes."""


def scanner_for(
    name: str, detector: int | None = None, detector_offset_mm: tuple[float, float] | None = None,
    truncation: float = 0.0
) -> Scanner:
    """Returns the scanner called ``name``, or that of a TOML file at this path.

    detector: another number of columns, with rows in proportion. detector_offset_mm: the panel's offset (v, u). truncation:
    the fraction of the columns that is cut off, half of these columns at each side. Raises InputError for an unknown name
    and for numbers out of range."""
    scanner = load_scanner(name, resource("data"))
    geometry = scanner.geometry
    if detector is not None:
        checks.within("--detector", detector, 1, _LARGEST_DETECTOR)
        rows, columns = geometry.detector_shape
        geometry = with_detector_count(geometry, max(1, round(detector * rows / columns)), detector)
    if detector_offset_mm is not None:
        geometry = replace(geometry, detector_offset_mm=detector_offset_mm)
    checks.within("--truncation", truncation, 0, 0.95)
    rows, columns = geometry.detector_shape
    remaining = max(1, columns - 2 * round(truncation * columns / 2))
    return replace(scanner, geometry=replace(geometry, detector_shape=(rows, remaining)))


def scanner_options(scanner: Scanner, protocol: str, **given: Any) -> SimulationOptions:
    """Returns options of a simulation with the protocol named ``protocol``. An option that is missing or None has the
    scanner's value if the scanner states one, else the default.

    Raises InputError for unknown options, values out of range, and values that contradict each other."""
    given = {key: value for key, value in given.items() if value is not None}
    order = readout_order(given.get("first"), given.get("readout_axis"), given.get("readout_direction"), flag_of)
    keys = ("readout_axis", "readout_direction", "lag", "readout_ratio", "pulse", "fps", "readout_ms")
    of_scanner = {key: getattr(scanner, key) for key in keys}
    if "readout_ratio" in given or "readout_ms" in given:  # each states the readout time, in place of the scanner's
        del of_scanner["readout_ratio"], of_scanner["readout_ms"]
    values = {**of_scanner, **given}
    values.update({key: value for key, value in zip(keys, order, strict=False) if value is not None})

    def named(name: str) -> str:
        is_scanner_s = name not in given and of_scanner.get(name) is not None
        return f"{scanner.name} [readout] {name}" if is_scanner_s else flag_of(name)

    check_readout(values.get("readout_ms"), values.get("readout_ratio"), values.get("fps"), named)
    timing = {key: values.pop(key) for key in _TIMING if key in values}
    sheet = {key: values.pop(key, None) for key in _DATA_SHEET}
    timed = make_protocol(protocol, **timing)
    if given.get("jitter_deg") and not timed.is_fly:  # jitter is only added to a fly-scan's angles
        found, remedy = f"{given['jitter_deg']} with --protocol {protocol}", "leave it out, or choose a fly-scan"
        raise InputError("--jitter-deg", found, "0", remedy)
    unused = [name for name in ("dose", "electronic_noise") if name in given and given.get("noise", "none") == "none"]
    if unused:
        subject = f"{flag_of(unused[0])} {checks.short_repr(given[unused[0]])}"
        raise InputError(subject, "--noise none", "a model of noise with it", "add --noise tigre or beer")
    if sheet["fps"] is not None:
        timed = timed.at_rate(sheet["fps"], sheet["readout_ms"], named)
    if isinstance(values.get("motion_of_object"), str | Path):
        values["motion_of_object"] = load_object_motion(values["motion_of_object"])
    return SimulationOptions(protocol=timed, **values)


def simulated_scan(
    rt: Runtime, of: str | Volume | EllipsoidPhantom | MovingPhantom, scanner: Scanner, options: SimulationOptions, *,
    size: int | None = None, pixel_samples: int = 0, name: str = "volume",
    report: Callable[[int, int], None] = lambda done, total: None
) -> Scan:
    """Returns a scanner's scan of a phantom (given by name or as an object) or of a volume. The scan's ``reference`` is the
    true volume.

    name: the volume's name, for titles. size: voxels along the longest side of grid and reference; None: the scanner's or
    the volume's. pixel_samples: rays along each side of a pixel; 0 chooses them by the size of the grid's voxels. report:
    called with the numbers of frames done and in all. Warns of an inverse crime (``Scene.warn_of_inverse_crime``)."""
    if size is not None:
        checks.within("--size", size, 1 if isinstance(of, Volume) else _SMALLEST_PHANTOM, _LARGEST_GRID)
    where, axis = (scanner.geometry, scanner.grid), options.readout_axis
    motion, window_s = options.motion_of_object, options.protocol.window_s()
    moves = None if motion is None else lambda box: motion.deformation(box, *window_s)
    if not isinstance(of, Volume):
        count = size or max(scanner.grid.shape)
        scene = phantom_scene(rt, of, *where, count, axis, options.seed, pixel_samples, moves)
    else:
        scene = volume_scene(rt, of, name, *where, size, axis, pixel_samples, moves)
    scene.warn_of_inverse_crime()
    protocol, step_deg = options.protocol, abs(options.protocol.step_deg)
    if protocol.is_fly and protocol.views > 1 and protocol.exposure_deg > _SLACK * step_deg:
        text = "an exposure of %.4g°, and %.4g° from frame to frame: no panel exposes two frames at the same time; shorten "
        log.warning(text + "the exposure (--exposure-deg), or take fewer frames", protocol.exposure_deg, step_deg)
    if options.time_samples == 0 and scene.fastest_mm_per_s > 0:
        samples = default_time_samples(options.protocol, scene.grid, scene.fastest_mm_per_s)
        options = replace(options, time_samples=samples)
    title = f"simulated scan of {scene.title}"
    scan = simulate(
        scene.source, scanner.geometry, scene.grid, options,
        reference=scene.reference, title=title, report=report,
        bone=scene.bone() if options.kvp and scene.bone is not None else None,
    )  # fmt: skip
    added = [name for name in ("rings", "sparks", "drift", "scatter", "kvp") if getattr(options, name)]
    stated = {key: getattr(options, key) for key in ("seed", "noise", "dose", "electronic_noise", *added)}
    facts = {"program": f"phyradgs-cl {__version__}", "simulated": scene.title, "pixel_samples": scene.source.pixel_samples}
    scan.provenance.update(facts | stated)
    if scene.state is None or (motion is None and scene.period_s is None):
        return scan
    if motion is not None:
        scan.provenance["motion_of_object"] = asdict(motion)
        times_s = motion.state_times_s(*window_s)
    else:
        # The true volumes are stored at eighths of the cycle in the middle of the scan.
        period_s = scene.period_s or 1.0
        times_s = (np.floor(sum(window_s) / 2 / period_s) + np.arange(_STATES) / _STATES) * period_s
    volumes = np.stack([scene.state(time_s) for time_s in times_s])
    volumes *= np.float32(scan.provenance["attenuation_factor"])  # type: ignore[arg-type]
    return replace(scan, moving_truth=MovingTruth(times_s, volumes, scene.deformation), gating=_gating(scan, scene))


def simulate(
    source: FrameSource, geometry: Geometry, grid: Grid, options: SimulationOptions, *,
    reference: np.ndarray | None = None, title: str = "simulated scan",
    report: Callable[[int, int], None] = lambda done, total: None, bone: FrameSource | None = None
) -> Scan:
    """Returns a scan of the object that ``source`` projects, with the noise and effects that ``options`` ask for.

    reference (nz, ny, nx): the object's true volume in 1/mm, which ``peak`` scales too. bone: projects the object's bone
    alone, as a beam of many energies needs it. Raises InputError for ``kvp`` without bone and for ``peak`` if no line
    integral is above 0, and NumericalError for line integrals that are not finite."""
    if options.kvp and bone is None:
        expected = "an object of voxels, whose dense ones are bone: foot, jaw or a volume"
        raise InputError("--kvp", "a phantom in closed form", expected, "leave it out")
    rng = np.random.default_rng(options.seed)
    protocol = options.protocol
    shutter = protocol.shutter(options.readout_axis, options.readout_direction)
    trajectory = protocol.orbit(geometry, options.jitter_deg, rng)
    lines = shutter.lines(geometry.detector_shape)
    samples = options.time_samples or default_time_samples(protocol, grid)
    start_s = protocol.frame_start_s()

    def table(frame: int) -> TimeCells:
        where = (trajectory, shutter, frame, float(start_s[frame]), lines)
        return per_line_cells(*where, samples) if protocol.is_fly else static_cells(*where)

    tables = [table(frame) for frame in range(protocol.views)]
    factor = 1.0
    if options.peak > 0:
        largest = max(float(frame.max()) for frame in source.frames(tables, "log", 1.0))
        if largest <= 0:
            raise InputError("--peak", "an empty object", "something that attenuates")
        factor = options.peak / largest
    spectrum = tube_spectrum(options.kvp) if options.kvp else None
    frames = np.empty((protocol.views, *geometry.detector_shape), np.float32)
    projected = source.frames(tables, options.detector_model, factor)
    for frame, (cells, projection) in enumerate(zip(tables, projected, strict=True)):
        frames[frame] = projection
        if spectrum is not None and bone is not None:
            dense = bone.frame(cells, options.detector_model, factor)
            frames[frame] = spectrum.hardened(np.maximum(frames[frame] - dense, 0), dense)
        if not np.all(np.isfinite(frames[frame])):
            found, expected = "line integrals that are not finite", "a smaller geometry or attenuation"
            raise NumericalError(f"frame {frame}", found, expected)
        report(frame + 1, protocol.views)
    if frames.max() <= 0:
        log.warning("no ray meets anything that attenuates: all %d frames are empty", protocol.views)
    share = shutter.readout.spread(shutter.lit_share(lines))
    recorded = _recorded(frames, options, np.where(share > 0, share, 1.0), rng)
    return Scan(
        # a line without light measures nothing: its line integrals are set to 0
        projections=recorded if np.all(share > 0) else recorded * (share > 0),
        geometry=geometry, trajectory=trajectory, shutter=shutter, frame_start_s=start_s, grid=grid, title=title,
        is_fly=protocol.is_fly, detector_model=options.detector_model, lag=options.lag,
        reference=None if reference is None else (reference * factor).astype(np.float32),
        provenance={"attenuation_factor": factor, "time_samples": samples},
    )  # fmt: skip


def _gating(scan: Scan, scene: Scene) -> Gating:
    """Returns the gating signal at the middle of every frame: the weight of the deformation's first field or, without a
    deformation, the phase of the phantom's period."""
    middle_s = scan.middle_times_s
    if scene.deformation is not None:
        return Gating(middle_s, scene.deformation.weights_at(middle_s)[:, 0])
    return Gating(middle_s, middle_s / (scene.period_s or 1.0) % 1.0, is_phase=True)


def default_time_samples(protocol: Protocol, grid: Grid, fastest_mm_per_s: float = 0.0) -> int:
    """Returns at how many times, 8 to 128, an exposure is sampled. Between two of these times, the volume's edge and the
    fastest part of a moving object move by at most half a voxel, unless this would take more than 128 times."""
    path_mm = np.deg2rad(protocol.exposure_deg) * max(grid.size_mm[1:]) / 2
    path_mm = max(path_mm, fastest_mm_per_s * protocol.exposure_s)
    return int(np.clip(np.ceil(2 * path_mm / min(grid.voxel_size_mm)), 8, 128))


def _recorded(frames: np.ndarray, options: SimulationOptions, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Adds the effects that ``options`` ask for to frames (F, v, u), in physical order. light: the fraction of the longest
    lit time for which each pixel receives light; it broadcasts with a frame."""
    if options.scatter > 0:
        frames = effects.add_scatter(frames, options.scatter).astype(np.float32)
    if options.drift > 0:
        frames = frames - np.log(effects.drifting_light(len(frames), options.drift, rng)).astype(np.float32)[:, None, None]
    if options.noise == "beer":
        frames = effects.beer_lambert_noise(frames, options.dose, options.electronic_noise, rng, light, options.lag)
    elif options.lag > 0:  # TIGRE's noisy counts are no intensities, so the lag is added before the noise
        frames = effects.lagged(frames, options.lag).astype(np.float32)
    if options.noise == "tigre":
        frames = effects.tigre_noise(frames, options.dose, options.electronic_noise, rng, light)
    if options.rings > 0:
        frames = frames - np.log(effects.pixel_gains(frames.shape[1:], options.rings, rng)).astype(np.float32)
    if options.sparks > 0:
        frames = effects.add_sparks(frames, options.sparks, rng)[0].astype(np.float32)
    return frames
