"""Simulation: a phantom or volume and an acquisition to frames, each line over its own time window."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any
from typing import Protocol as Interface

import numpy as np

from phyradgs_cl import __version__, checks
from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan, make_protocol, pixel_centres
from phyradgs_cl.acquisition.cells import TimeCells, per_line_cells, static_cells
from phyradgs_cl.acquisition.scan import LARGEST_LAG
from phyradgs_cl.detector import (
    add_scatter,
    add_sparks,
    average,
    beer_lambert_noise,
    drifting_light,
    lagged,
    pixel_gains,
    tigre_noise,
    tube_spectrum,
)
from phyradgs_cl.detector.spectrum import HIGHEST_KVP, LOWEST_KVP
from phyradgs_cl.errors import InputError, NumericalError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import LoadedVolume, Scanner, load_scanner, with_detector_count
from phyradgs_cl.operators import RayProjector
from phyradgs_cl.phantoms import EllipsoidPhantom, make_phantom
from phyradgs_cl.resources import resource
from phyradgs_cl.runtime import Runtime


class FrameSource(Interface):
    """Whatever can be projected: the merged frame of a cell table, attenuation multiplied by ``factor``."""

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray: ...


NOISES = ("none", "tigre", "beer")
# Far beyond any scanner, and far from where float32 or a sampler would overflow.
LARGEST_PEAK, LARGEST_ELECTRONIC_NOISE = 1e4, 1e9
SMALLEST_DOSE, LARGEST_DOSE = 1e-3, 1e12
LARGEST_GRID, LARGEST_DETECTOR = 4096, 32_000
_DENSE = 0.5  # of the largest attenuation: from here a voxel is bone, in a beam of many energies
SMALLEST_PHANTOM = 2  # procedural phantoms are drawn on twice as many voxels, of which they need 4
_TIMING = ("views", "exposure_deg", "readout_ratio", "start_deg", "pulse")
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SimulationOptions:
    """How to simulate. ``peak`` > 0 scales attenuation so that the largest line integral is ``peak``.

    time_samples: midpoint samples per line in its own exposure; 0: the volume's edge moves at most half a voxel of ``grid``
    between two (docs/mathematics.md). dose: photons of a pixel without object, on a line that sees the whole pulse.
    lag: λ of detector/lag.py. rings, sparks, drift, scatter: of detector/effects.py, 0 without; kvp: of
    detector/spectrum.py, 0 for a beam of one energy.
    """

    protocol: Protocol = Protocol()
    readout_axis: str = "rows"
    readout_direction: int = 1
    detector_model: str = "log"
    peak: float = 0.0
    noise: str = "none"
    dose: float = 1e4
    electronic_noise: float = 10.0
    jitter_deg: float = 0.0
    lag: float = 0.0
    time_samples: int = 0
    seed: int = 0
    rings: float = 0.0
    sparks: float = 0.0
    drift: float = 0.0
    scatter: float = 0.0
    kvp: float = 0.0

    def __post_init__(self) -> None:
        if self.noise not in NOISES:
            raise InputError("--noise", repr(self.noise), f"one of {', '.join(NOISES)}")
        checks.within("--peak", self.peak, 0, LARGEST_PEAK)
        checks.within("--electronic-noise (counts)", self.electronic_noise, 0, LARGEST_ELECTRONIC_NOISE)
        checks.within("--dose (photons per pixel)", self.dose, SMALLEST_DOSE, LARGEST_DOSE)
        checks.within("--lag", self.lag, 0, LARGEST_LAG)
        checks.within("--jitter-deg", self.jitter_deg, 0, 360)
        checks.within("--time-samples", self.time_samples, 0, 10_000)
        checks.within("--seed", self.seed, 0, 2**63)
        checks.fields_within("--", self, {"rings": (0, 0.5), "sparks": (0, 0.1), "drift": (0, 0.5), "scatter": (0, 10)})
        if self.kvp != 0:
            checks.within("--kvp (kV)", self.kvp, LOWEST_KVP, HIGHEST_KVP)


OPTION_NAMES = frozenset({f.name for f in fields(SimulationOptions)} - {"protocol"}).union(_TIMING)
"""What ``scanner_options`` takes."""


def scanner_for(
    name: str,
    detector: int | None = None,
    detector_offset_mm: tuple[float, float] | None = None,
    truncation: float = 0.0,
) -> Scanner:
    """A scanner by name or TOML file, with another number of columns (rows in proportion) or offset (v, u) of the panel, and
    without the share ``truncation`` of its columns, half of it at each side."""
    scanner = load_scanner(name, resource("data"))
    geometry = scanner.geometry
    if detector is not None:
        checks.within("--detector", detector, 1, LARGEST_DETECTOR)
        rows, columns = geometry.detector_shape
        geometry = with_detector_count(geometry, max(1, round(detector * rows / columns)), detector)
    if detector_offset_mm is not None:
        geometry = replace(geometry, detector_offset_mm=detector_offset_mm)
    checks.within("--truncation", truncation, 0, 0.95)
    rows, columns = geometry.detector_shape
    kept = max(1, columns - 2 * round(truncation * columns / 2))
    return replace(scanner, geometry=replace(geometry, detector_shape=(rows, kept)))


def scanner_options(scanner: Scanner, protocol: str, **given: Any) -> SimulationOptions:
    """Fields of ``SimulationOptions`` and of the named protocol; what is None or missing is the scanner's, then the
    default. InputError: no such option; a value out of range."""
    usual = ("readout_axis", "readout_direction", "lag", "readout_ratio", "pulse")
    own = {key: getattr(scanner, key) for key in usual}
    chosen = {**own, **{key: value for key, value in given.items() if value is not None}}
    if unknown := sorted(set(chosen) - OPTION_NAMES):
        expected = f"one of {', '.join(sorted(OPTION_NAMES))}"
        raise InputError(f"simulate: option {unknown[0]}", "no such option", expected)
    timing = {key: chosen.pop(key) for key in _TIMING if key in chosen}
    return SimulationOptions(protocol=make_protocol(protocol, **timing), **chosen)


def simulated_scan(
    rt: Runtime,
    of: str | LoadedVolume | EllipsoidPhantom,
    scanner: Scanner,
    options: SimulationOptions,
    *,
    size: int | None = None,
    pixel_samples: int = 1,
    name: str = "volume",
    report: Callable[[int, int], None] = lambda done, total: None,
) -> Scan:
    """What a scanner records of a phantom, by its name or of one's own, or of a volume, called ``name``; the truth is its
    reference.
    size: voxels along the longest side of grid and reference; None takes the scanner's or the volume's. pixel_samples:
    rays along each side of a pixel. Warns of an inverse crime."""
    if size is not None:
        checks.within("--size", size, 1 if isinstance(of, LoadedVolume) else SMALLEST_PHANTOM, LARGEST_GRID)
    where, axis = (scanner.geometry, scanner.grid), options.readout_axis
    if not isinstance(of, LoadedVolume):
        count = size or max(scanner.grid.shape)
        scene = phantom_scene(rt, of, *where, count, axis, options.seed, pixel_samples)
    else:
        scene = volume_scene(rt, of, name, *where, size, axis, pixel_samples)
    scene.warn_of_inverse_crime()
    title = f"simulated scan of {scene.title}"
    scan = simulate(
        scene.source, scanner.geometry, scene.grid, options,
        reference=scene.reference, title=title, report=report,
        bone=scene.bone() if options.kvp and scene.bone is not None else None,
    )  # fmt: skip
    effects = [name for name in ("rings", "sparks", "drift", "scatter", "kvp") if getattr(options, name)]
    asked = {key: getattr(options, key) for key in ("seed", "noise", "dose", "electronic_noise", *effects)}
    told = {"program": f"phyradgs-cl {__version__}", "simulated": scene.title, "pixel_samples": pixel_samples}
    scan.provenance.update(told | asked)
    return scan


def simulate(
    source: FrameSource,
    geometry: ConeGeometry,
    grid: Grid,
    options: SimulationOptions,
    *,
    reference: np.ndarray | None = None,
    title: str = "simulated scan",
    report: Callable[[int, int], None] = lambda done, total: None,
    bone: FrameSource | None = None,
) -> Scan:
    """A scan of whatever ``source`` projects, noise included, with its reference (nz, ny, nx), scaled along by ``peak``.
    bone: the part of it that is bone, which a beam of many energies (``kvp``) asks for."""
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
        largest = max(float(source.frame(t, "log", 1.0).max()) for t in tables)
        if largest <= 0:
            raise InputError("--peak", "an empty object", "something that attenuates")
        factor = options.peak / largest
    spectrum = tube_spectrum(options.kvp) if options.kvp else None
    frames = np.empty((protocol.views, *geometry.detector_shape), np.float32)
    for frame, cells in enumerate(tables):
        frames[frame] = source.frame(cells, options.detector_model, factor)
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


def default_time_samples(protocol: Protocol, grid: Grid) -> int:
    """Enough that the edge of the volume moves at most half a voxel from sample to sample (at least 8)."""
    path_mm = np.deg2rad(protocol.exposure_deg) * max(grid.size_mm[1:]) / 2
    return int(np.clip(np.ceil(2 * path_mm / min(grid.voxel_size_mm)), 8, 128))


class VolumeSource:
    """Frames of a voxel volume (z, y, x) in 1/mm by the ray-driven projector."""

    def __init__(
        self, rt: Runtime, volume: np.ndarray, grid: Grid, geometry: ConeGeometry, axis: str
    ) -> None:
        self._projector = RayProjector(rt, grid, geometry.detector_shape, axis)
        self._volume = volume
        self._factor: float | None = None

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        if factor != self._factor:
            self._on_device = self._projector.upload_volume(self._volume * np.float32(factor))
            self._factor = factor
        return self._projector.forward(self._on_device, cells, model)


class AnalyticSource:
    """Frames of a phantom with closed-form line integrals, in float64."""

    def __init__(self, phantom: EllipsoidPhantom, geometry: ConeGeometry) -> None:
        self._phantom, self._geometry = phantom, geometry

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        frame = np.empty(self._geometry.detector_shape)
        by_row = cells.axis == "rows"
        for start, stop, members in line_groups(cells):
            pixels = pixel_centres(cells.pose[members], self._geometry.detector_shape)
            target = pixels[:, start:stop] if by_row else pixels[:, :, start:stop]
            p = factor * self._phantom.line_integrals(cells.pose[members][:, None, None, :3], target)
            mean = average(p, cells.weight[members], model)
            frame[(slice(start, stop),) if by_row else (slice(None), slice(start, stop))] = mean
        return frame.astype(np.float32)


class PixelAreaSource:
    """Frames of pixels that see the mean over their area: of ``samples`` by ``samples`` rays of a finer panel."""

    def __init__(self, finer: FrameSource, samples: int) -> None:
        self._finer, self._samples = finer, samples

    def frame(self, cells: TimeCells, model: str, factor: float) -> np.ndarray:
        n = self._samples
        fine = self._finer.frame(cells.finer(n), model, factor)
        rows, columns = fine.shape[0] // n, fine.shape[1] // n
        rays = fine.reshape(rows, n, columns, n).transpose(1, 3, 0, 2).reshape(n * n, rows, columns)
        return average(rays, np.full(n * n, 1 / n**2), model).astype(np.float32)


def _on_panel(
    geometry: ConeGeometry, pixel_samples: int, make: Callable[[ConeGeometry], FrameSource]
) -> FrameSource:
    """What ``make`` gives for the panel, or for a finer one behind the area of its pixels."""
    checks.within("--pixel-samples", pixel_samples, 1, 32)
    if pixel_samples == 1:
        return make(geometry)
    return PixelAreaSource(make(geometry.finer(pixel_samples)), pixel_samples)


@dataclass(frozen=True, eq=False)
class Scene:
    """What is to be scanned: a source of frames, the grid asked for, and the truth on it (nz, ny, nx). source_shape:
    voxels (z, y, x) that are projected, where the source is a volume from outside. bone: the dense part of the source."""

    source: FrameSource
    grid: Grid
    reference: np.ndarray
    title: str
    source_shape: tuple[int, int, int] | None = None
    bone: Callable[[], FrameSource] | None = None

    def warn_of_inverse_crime(self) -> None:
        """Says so where the projected voxels are no finer than the grid: reconstructions there look better than they are."""
        shape = self.source_shape
        if shape is None or any(n > m for n, m in zip(shape, self.grid.shape, strict=True)):
            return
        text = "%s: %s voxels are projected and a grid of %s is to be reconstructed: discretisation errors will not show "
        told = text + "(inverse crime); take a smaller --size or a finer volume"
        log.warning(told, self.title, *("×".join(map(str, counts)) for counts in (shape, self.grid.shape)))


def phantom_scene(
    rt: Runtime,
    of: str | EllipsoidPhantom,
    geometry: ConeGeometry,
    box: Grid,
    size: int,
    axis: str,
    seed: int,
    pixel_samples: int = 1,
) -> Scene:
    """A phantom, one's own or by its name, in the scanner's box, with ``size`` voxels per side. Closed forms are integrated
    exactly; procedural phantoms are projected at twice ``size``, and the truth is their block mean. Pixels see
    ``pixel_samples``² rays over their area."""
    half_size_mm = min(box.size_mm) / 2
    phantom = make_phantom(of, half_size_mm, 2 * size, seed) if isinstance(of, str) else of
    if isinstance(phantom, EllipsoidPhantom):
        grid = _resized(box, size)
        source = _on_panel(geometry, pixel_samples, lambda panel: AnalyticSource(phantom, panel))
        return Scene(source, grid, phantom.voxelise(grid, 4), f"phantom {phantom.name}")
    fine = Grid.cube(2 * size, 2 * half_size_mm)
    if not (np.allclose(box.size_mm, fine.size_mm) and np.allclose(box.offset_mm, 0)):
        text = "phantom %s is drawn in a cube of %g mm about the axis: the shape and offset of the scanner's [volume] "
        log.warning(text + "are not used", of, 2 * half_size_mm)
    volume = phantom.voxelise(fine)
    source, bone = _voxel_sources(rt, volume, fine, geometry, axis, pixel_samples)
    truth = block_mean(volume, (size,) * 3)
    return Scene(source, Grid.cube(size, 2 * half_size_mm), truth, f"phantom {of}", bone=bone)


def volume_scene(
    rt: Runtime,
    loaded: LoadedVolume,
    name: str,
    geometry: ConeGeometry,
    box: Grid,
    size: int | None,
    axis: str,
    pixel_samples: int = 1,
) -> Scene:
    """A volume, called ``name``, projected at its own resolution by ``pixel_samples``² rays per pixel. A bare array is
    fitted into the scanner's box, its values attenuation per half of the longest side; one with a grid keeps it and 1/mm."""
    volume, fine = loaded.volume, loaded.grid
    if fine is None:
        voxel_mm = min(side / n for side, n in zip(box.size_mm, volume.shape, strict=True))
        fine = Grid(volume.shape, (voxel_mm,) * 3, box.offset_mm)
        volume = volume / np.float32(fine.half_longest_mm)
    grid = _resized(fine, size or max(fine.shape))
    source, bone = _voxel_sources(rt, volume, fine, geometry, axis, pixel_samples)
    return Scene(source, grid, block_mean(volume, grid.shape), name, fine.shape, bone)


def _voxel_sources(
    rt: Runtime, volume: np.ndarray, grid: Grid, geometry: ConeGeometry, axis: str, pixel_samples: int
) -> tuple[FrameSource, Callable[[], FrameSource]]:
    """Frames of a volume, and, made when they are asked for, of what is bone in it."""

    def of(values: np.ndarray) -> FrameSource:
        return _on_panel(geometry, pixel_samples, lambda panel: VolumeSource(rt, values, grid, panel, axis))

    return of(volume), lambda: of(np.where(volume >= _DENSE * volume.max(), volume, 0).astype(np.float32))


def block_mean(volume: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Means of a volume (z, y, x) over the voxels of a coarser (or equal) grid of the same box, float32."""
    if volume.shape == tuple(shape):
        return volume.astype(np.float32)
    from skimage.transform import resize_local_mean  # slow to import

    mean = resize_local_mean(volume.astype(np.float32), shape, grid_mode=True, preserve_range=True)
    return mean.astype(np.float32)


def _resized(grid: Grid, count: int) -> Grid:
    if count < 1:
        raise InputError("--size", str(count), "at least 1 voxel")
    shape = [max(1, round(n * count / max(grid.shape))) for n in grid.shape]
    voxel = [side / n for side, n in zip(grid.size_mm, shape, strict=True)]
    return Grid((shape[0], shape[1], shape[2]), (voxel[0], voxel[1], voxel[2]), grid.offset_mm)


def line_groups(cells: TimeCells) -> Iterator[tuple[int, int, np.ndarray]]:
    """(first line, line after the last, cells) for every run of lines that the same cells serve."""
    ranges = np.stack([cells.line_start, cells.line_stop], -1)
    for start, stop in np.unique(ranges, axis=0):
        yield int(start), int(stop), np.flatnonzero((ranges == (start, stop)).all(axis=1))


def _recorded(
    frames: np.ndarray, options: SimulationOptions, light: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Frames (F, v, u) with scatter, the light of each frame, noise, gains and sparks, as far as they are asked for."""
    if options.scatter > 0:
        frames = add_scatter(frames, options.scatter).astype(np.float32)
    if options.drift > 0:
        frames = frames - np.log(drifting_light(len(frames), options.drift, rng)).astype(np.float32)[:, None, None]
    frames = _with_noise(frames, options, light, rng)
    if options.rings > 0:
        frames = frames - np.log(pixel_gains(frames.shape[1:], options.rings, rng)).astype(np.float32)
    if options.sparks > 0:
        frames = add_sparks(frames, options.sparks, rng)[0].astype(np.float32)
    return frames


def _with_noise(
    frames: np.ndarray, options: SimulationOptions, light: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """What the panel shows of frames (F, v, u): TIGRE's counts are no real intensities, so there the lag comes first."""
    if options.noise == "beer":
        return beer_lambert_noise(frames, options.dose, options.electronic_noise, rng, light, options.lag)
    if options.lag > 0:
        frames = lagged(frames, options.lag).astype(np.float32)
    if options.noise == "tigre":
        return tigre_noise(frames, options.dose, options.electronic_noise, rng, light)
    return frames
