"""Simulates what a panel records in a turning cone beam: RTK's line integrals at many moments, windows and noise by NumPy.

World axes are those of docs/mathematics.md. RTK's (X, Y, Z) are (y, z, x) here; gantry angles are the same."""

from dataclasses import dataclass

import itk
import numpy as np
from itk import RTK as rtk
from objects import SIZE, VOXEL_MM

IMAGE = itk.Image[itk.F, 3]
NODE_DEG = 0.6  # largest turn of the gantry from one rendered moment to the next
SHEPP_LOGAN = "shepp_logan"  # RTK projects this one object in closed form
SHEPP_LOGAN_SCALE_MM = 46.0


@dataclass(frozen=True)
class Setup:
    """A scanner and its protocol, as it is or as a file states it, in mm, degrees and seconds."""

    views: int = 36
    step_deg: float = 10.0
    first_deg: float = 0.0
    source_mm: float = 400.0  # from the source to the axis
    detector_mm: float = 600.0  # from the source to the panel
    rows: int = 96
    columns: int = 96
    pitch_v_mm: float = 1.8
    pitch_u_mm: float = 1.8
    offset_v_mm: float = 0.0
    offset_u_mm: float = 0.0
    roll_deg: float = 0.0  # of the panel about its normal, from u towards v
    frame_time_s: float = 1.0
    exposure_s: float = 0.5
    readout_s: float = 0.4
    axis: str = "rows"
    direction: int = 1
    moving: bool = True  # whether the gantry turns within frames
    rotates: str = "gantry"
    model: str = "intensity"

    @property
    def starts_s(self) -> np.ndarray:
        return np.arange(self.views) * self.frame_time_s

    def angle_deg(self, time_s: np.ndarray) -> np.ndarray:
        return self.first_deg + self.step_deg * time_s / self.frame_time_s

    @property
    def opening_s(self) -> np.ndarray:
        """Returns when each line (lines,) opens after its frame's start, in s."""
        lines = self.rows if self.axis == "rows" else self.columns
        return np.linspace(0.0, self.readout_s, lines)[:: self.direction]

    @property
    def span_s(self) -> float:
        return self.exposure_s + self.readout_s

    def pose(self, angle_deg: np.ndarray) -> np.ndarray:
        """Returns poses (T, 12) in world mm: source, centre of pixel (0, 0), steps along u and along v."""
        angle, roll = np.deg2rad(angle_deg), np.deg2rad(self.roll_deg)
        flat = np.zeros_like(angle)
        outwards = np.stack([np.cos(angle), np.sin(angle), flat], -1)
        along = np.stack([-np.sin(angle), np.cos(angle), flat], -1)
        up = np.array([0.0, 0.0, 1.0])
        centre = (self.source_mm - self.detector_mm) * outwards
        centre += self.offset_u_mm * along + self.offset_v_mm * up
        u = (np.cos(roll) * along + np.sin(roll) * up) * self.pitch_u_mm
        v = (np.cos(roll) * up - np.sin(roll) * along) * self.pitch_v_mm
        corner = centre - (self.columns - 1) / 2 * u - (self.rows - 1) / 2 * v
        return np.concatenate([self.source_mm * outwards, corner, u, v], -1)


@dataclass(frozen=True)
class Panel:
    """How a panel counts the frames."""

    photons: float = 2e4  # per pixel without an object
    flats: int = 16
    darks: int = 8
    dark_level: float = 100.0
    noise: float = 5.0  # of reading, in counts
    peak: float = 3.0  # the largest line integral
    digital: bool = True  # True: uint16, False: float32


@dataclass
class Recorded:
    """Counts of frames (F, v, u), flats and darks, and a mask (v, u) of pixels known to be dead."""

    frames: np.ndarray
    flats: np.ndarray
    darks: np.ndarray
    mask: np.ndarray | None = None


def _image(values: np.ndarray, spacing: tuple[float, ...], origin: tuple[float, ...]) -> IMAGE:
    image = itk.image_from_array(np.ascontiguousarray(values, np.float32))
    image.SetSpacing(spacing)
    image.SetOrigin(origin)
    return image


def geometry(setup: Setup, angles_deg: np.ndarray) -> rtk.ThreeDCircularProjectionGeometry:
    """Returns RTK's own circular geometry. Offsets are in the stack's origin."""
    found = rtk.ThreeDCircularProjectionGeometry.New()
    for angle in angles_deg:
        found.AddProjection(setup.source_mm, setup.detector_mm, float(angle), 0, 0, 0, setup.roll_deg)
    return found


def stack_origin(setup: Setup) -> tuple[float, float, float]:
    roll = np.deg2rad(setup.roll_deg)  # a rolled panel is shifted along its own axes
    u = np.cos(roll) * setup.offset_u_mm + np.sin(roll) * setup.offset_v_mm
    v = np.cos(roll) * setup.offset_v_mm - np.sin(roll) * setup.offset_u_mm
    return (u - (setup.columns - 1) / 2 * setup.pitch_u_mm, v - (setup.rows - 1) / 2 * setup.pitch_v_mm, 0.0)


def line_integrals(setup: Setup, angles_deg: np.ndarray, density: np.ndarray | None) -> np.ndarray:
    """Returns line integrals (T, v, u) of a density (z, y, x), or of RTK's Shepp-Logan phantom for None."""
    empty = np.zeros((len(angles_deg), setup.rows, setup.columns), np.float32)
    stack = _image(empty, (setup.pitch_u_mm, setup.pitch_v_mm, 1.0), stack_origin(setup))
    if density is None:
        project = rtk.SheppLoganPhantomFilter[IMAGE, IMAGE].New()
        project.SetInput(stack)
        project.SetPhantomScale(SHEPP_LOGAN_SCALE_MM)
    else:
        project = rtk.JosephForwardProjectionImageFilter[IMAGE, IMAGE].New()
        project.SetInput(0, stack)
        corner = -(SIZE - 1) / 2 * VOXEL_MM
        project.SetInput(1, _image(density.transpose(2, 0, 1), (VOXEL_MM,) * 3, (corner,) * 3))
    project.SetGeometry(geometry(setup, angles_deg))
    project.Update()
    return itk.array_from_image(project.GetOutput())


def window_weights(setup: Setup, nodes_s: np.ndarray) -> np.ndarray:
    """Returns weights (lines, T) of values at nodes: the mean over a line's exposure of their linear interpolation."""
    if setup.exposure_s == 0:
        raise ValueError("a line needs an exposure")
    opening = setup.opening_s[:, None]
    step = nodes_s[1] - nodes_s[0]

    def area(until: np.ndarray) -> np.ndarray:
        """Returns the integral of every node's hat function up to a time."""
        x = np.clip((until - nodes_s) / step, -1.0, 1.0)
        return step * np.where(x < 0, (1 + x) ** 2 / 2, 1 - (1 - x) ** 2 / 2)

    return (area(opening + setup.exposure_s) - area(opening)) / setup.exposure_s


def transmissions(setup: Setup, density: np.ndarray | None, peak: float) -> np.ndarray:
    """Returns mean transmissions (F, v, u) of the frames of a density, scaled so that the largest line integral is ``peak``.

    A frame averages intensities, or line integrals with the model "log". At rest it has one moment."""
    count = 1
    if setup.moving:
        count = int(np.ceil(abs(setup.step_deg) * setup.span_s / setup.frame_time_s / NODE_DEG)) + 1
    nodes_s = np.linspace(0.0, setup.span_s, max(count, 2)) if setup.moving else np.zeros(1)
    angles = setup.angle_deg(setup.starts_s[:, None] + nodes_s)
    integrals = line_integrals(setup, angles.ravel(), density)
    values = (peak / float(integrals.max()) * integrals).reshape(setup.views, len(nodes_s), setup.rows, setup.columns)
    if not setup.moving:
        return np.exp(-values[:, 0])
    form = "lt,ftlu->flu" if setup.axis == "rows" else "lt,ftvl->fvl"
    weights = window_weights(setup, nodes_s)
    if setup.model == "log":
        return np.exp(-np.einsum(form, weights, values))
    return np.einsum(form, weights, np.exp(-values))


def counted(panel: Panel, transmission: np.ndarray, gain: np.ndarray, rng: np.random.Generator) -> Recorded:
    """Returns counts with photon noise, the panel's own pattern, darks and reading noise. ``gain`` (F,): the source's."""
    shape = transmission.shape[1:]
    v, u = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    pattern = panel.photons * (1 - 0.15 * (u**2 + v**2)) * rng.normal(1.0, 0.03, shape).clip(0.8, 1.2)

    def read(expected: np.ndarray) -> np.ndarray:
        counts = rng.poisson(expected) + rng.normal(panel.dark_level, panel.noise, expected.shape)
        return np.rint(np.maximum(counts, 0.0)) if panel.digital else np.maximum(counts, 0.0)

    return Recorded(
        read(transmission * gain[:, None, None] * pattern),
        read(np.broadcast_to(pattern, (panel.flats, *shape))),
        read(np.zeros((panel.darks, *shape))),
    )
