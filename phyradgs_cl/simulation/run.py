"""Simulates a scan from a source of frames and an acquisition. Each line averages over its own time window."""

import logging
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np

from phyradgs_cl import __version__, checks
from phyradgs_cl.acquisition import Protocol, Scan
from phyradgs_cl.acquisition.cells import per_line_cells, static_cells
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.detector import effects, tube_spectrum
from phyradgs_cl.errors import InputError, NumericalError
from phyradgs_cl.fields import Gating, Grid, MovingTruth
from phyradgs_cl.io import Scanner, Volume
from phyradgs_cl.phantoms import EllipsoidPhantom, MovingPhantom
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation.options import SimulationOptions
from phyradgs_cl.simulation.scenes import Scene, phantom_scene, volume_scene
from phyradgs_cl.simulation.sources import FrameSource

_LARGEST_GRID = 4096  # most voxels along a side of the volume
_SMALLEST_PHANTOM = 2  # least number of voxels along a side: procedural phantoms need 4 and are drawn on twice as many
_STATES = 8  # number of stored states of a phantom whose bodies move
log = logging.getLogger(__name__)


def simulated_scan(
    rt: Runtime, of: str | Volume | EllipsoidPhantom | MovingPhantom, scanner: Scanner, options: SimulationOptions, *,
    size: int | None = None, pixel_samples: int = 0, name: str = "volume",
    report: Callable[[int, int], None] = lambda done, total: None
) -> Scan:
    """Returns a scanner's scan of a phantom (given by name or as an object) or of a volume. The truth is its reference.

    name: that of the volume. size: voxels along the longest side of grid and reference; None takes the scanner's or the
    volume's. pixel_samples: rays along each side of a pixel; 0 takes the truth's voxels. Warns of an inverse crime."""
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
        # Times are eighths of the cycle about the middle of the scan.
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
    """Returns a scan of the object that ``source`` projects, with noise.

    reference (nz, ny, nx): the truth in 1/mm, which ``peak`` scales too. bone: the source of the object's bone, for a
    beam of many energies."""
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
        projections=recorded if np.all(share > 0) else recorded * (share > 0),  # lines without light are masked
        geometry=geometry,
        trajectory=trajectory,
        shutter=shutter,
        frame_start_s=start_s,
        grid=grid,
        is_fly=protocol.is_fly,
        detector_model=options.detector_model,
        lag=options.lag,
        reference=None if reference is None else (reference * factor).astype(np.float32),
        title=title,
        provenance={"attenuation_factor": factor, "time_samples": samples},
    )


def _gating(scan: Scan, scene: Scene) -> Gating:
    """Returns the weight of the first field in the middle of every frame. Without a field it is the phase of the motion."""
    middle_s = np.asarray(scan.frame_start_s) + scan.shutter.span_s / 2
    if scene.deformation is not None:
        return Gating(middle_s, scene.deformation.weights_at(middle_s)[:, 0])
    return Gating(middle_s, middle_s / (scene.period_s or 1.0) % 1.0, is_phase=True)


def default_time_samples(protocol: Protocol, grid: Grid, fastest_mm_per_s: float = 0.0) -> int:
    """Returns the number of time samples per line, at least 8. From one to the next, the volume's edge, or the fastest
    part of a moving object, goes at most half a voxel."""
    path_mm = np.deg2rad(protocol.exposure_deg) * max(grid.size_mm[1:]) / 2
    path_mm = max(path_mm, fastest_mm_per_s * protocol.exposure_s)
    return int(np.clip(np.ceil(2 * path_mm / min(grid.voxel_size_mm)), 8, 128))


def _recorded(frames: np.ndarray, options: SimulationOptions, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Adds scatter, drifting light, noise, gains and sparks to frames (F, v, u), as the options say."""
    if options.scatter > 0:
        frames = effects.add_scatter(frames, options.scatter).astype(np.float32)
    if options.drift > 0:
        frames = frames - np.log(effects.drifting_light(len(frames), options.drift, rng)).astype(np.float32)[:, None, None]
    frames = _with_noise(frames, options, light, rng)
    if options.rings > 0:
        frames = frames - np.log(effects.pixel_gains(frames.shape[1:], options.rings, rng)).astype(np.float32)
    if options.sparks > 0:
        frames = effects.add_sparks(frames, options.sparks, rng)[0].astype(np.float32)
    return frames


def _with_noise(frames: np.ndarray, options: SimulationOptions, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Adds lag and noise to frames (F, v, u). TIGRE's counts are no real intensities: lag comes before noise."""
    if options.noise == "beer":
        return effects.beer_lambert_noise(frames, options.dose, options.electronic_noise, rng, light, options.lag)
    if options.lag > 0:
        frames = effects.lagged(frames, options.lag).astype(np.float32)
    if options.noise == "tigre":
        return effects.tigre_noise(frames, options.dose, options.electronic_noise, rng, light)
    return frames
