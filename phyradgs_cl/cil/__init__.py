"""A plug-in for CIL, the Core Imaging Library (Jørgensen et al., Phil. Trans. R. Soc. A 379 (2021) 20200192): projector and
filtered backprojection on any OpenCL device, also for a gantry that turns during an exposure.

CIL does not fix a unit of length; here it is taken as mm. The object turns by initial angle + angle about z."""

from collections.abc import Callable
from typing import Any

import numpy as np
from cil.framework import AcquisitionGeometry, BlockGeometry, DataContainer, DataProcessor, ImageGeometry
from cil.optimisation.operators import BlockOperator, LinearOperator

from phyradgs_cl.acquisition.scans_from import poses_of_astra
from phyradgs_cl.api import Grid, Motion, Scan, Shutter, ray_operator, reconstruct
from phyradgs_cl.api.runs import Device
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import triple

_ORDER = ("channel", "angle", "projection", "vertical", "horizontal_y", "horizontal_x", "horizontal")
_FLAT = np.array([0.0, 0.0, 1e-3])  # the panel's direction to a next row in 2D: out of the plane, for a short step


class ProjectionOperator(LinearOperator):
    """Joseph's projector from CIL's image geometry to its acquisition geometry, with its exact transpose.

    image_geometry: None takes CIL's default. acquisition_geometry: cone, parallel or cone_flex, in 3D or 2D, with any
    offset or tilt, order of dimensions, origin of the panel and channels. A BlockGeometry gives a BlockOperator.

    shutter, deg_per_s: when each line of a fly-scan is exposed, and how fast the object turns, positive if angles rise. The
    geometry's angles then hold in the middle of each frame. motion: a model of docs/methods.md except ``exact``. device:
    what ``--device`` takes, or a Runtime.

    Raises InputError for a grid that no ray meets, an unknown motion, and a shutter with cone_flex."""

    def __new__(cls, image_geometry: Any = None, acquisition_geometry: Any = None, **others: Any) -> Any:
        if isinstance(acquisition_geometry, BlockGeometry):
            return BlockOperator(*(cls(image_geometry, one, **others) for one in acquisition_geometry))
        return super().__new__(cls)

    def __init__(
        self, image_geometry: ImageGeometry | None = None, acquisition_geometry: AcquisitionGeometry | None = None, *,
        shutter: Shutter | None = None, deg_per_s: float = 0.0, motion: str | Motion = "per-row", device: Device = None,
    ) -> None:  # fmt: skip
        image, frames = _both(image_geometry, acquisition_geometry)
        super().__init__(domain_geometry=image, range_geometry=frames)
        self.rays = ray_operator(scan_of(image, frames, shutter=shutter, deg_per_s=deg_per_s), motion, device=device)

    def direct(self, x: DataContainer, out: DataContainer | None = None) -> DataContainer:
        """Returns the line integrals of an image, in ``out`` if given."""
        return _mapped(self.rays, x, self.domain_geometry(), self.range_geometry(), out)

    def adjoint(self, x: DataContainer, out: DataContainer | None = None) -> DataContainer:
        """Returns the image to which the transpose of ``direct`` maps line integrals, in ``out`` if given."""
        return _mapped(self.rays.T, x, self.range_geometry(), self.domain_geometry(), out)


class FBP(DataProcessor):
    """Filtered backprojection: FDK for cone beams, FBP for parallel ones; ``FBP(image_geometry, data.geometry)(data)``.

    shutter, deg_per_s: as in ``ProjectionOperator``. options: device, and options of the methods fdk and fbp, such as
    window="hann". Raises InputError for data of another geometry, and for orbits that are far from a circle about z."""

    def __init__(
        self, image_geometry: ImageGeometry | None = None, acquisition_geometry: AcquisitionGeometry | None = None, *,
        shutter: Shutter | None = None, deg_per_s: float = 0.0, **options: Any,
    ) -> None:  # fmt: skip
        image, frames = _both(image_geometry, acquisition_geometry)
        way = {"shutter": shutter, "deg_per_s": deg_per_s}
        super().__init__(image_geometry=image, acquisition_geometry=frames, way=way, options=options)

    def check_input(self, dataset: DataContainer) -> bool:
        """Raises InputError for data of another geometry; otherwise returns True, as CIL expects."""
        if dataset.geometry != self.acquisition_geometry:
            raise InputError("data", "another geometry", "that of the processor", "FBP(image_geometry, data.geometry)")
        return True

    def _set_up(self) -> None:
        self._shape_out = self.image_geometry.shape

    def process(self, out: DataContainer | None = None) -> DataContainer:
        """Reconstructs the volume from the input. Returns it, in ``out`` if given."""
        between = self.image_geometry, self.acquisition_geometry
        method = "fbp" if between[1].geom_type == "parallel" else "fdk"

        def volume(values: np.ndarray) -> np.ndarray:
            return reconstruct(scan_of(*between, values, **self.way), method, report=False, **self.options).volume

        return _mapped(volume, self.get_input(), *between[::-1], out)


class _Turning:
    """The trajectory of a gantry that turns at constant speed during each frame."""

    def __init__(self, frames: AcquisitionGeometry, shutter: Shutter, rad_per_s: float) -> None:
        self._at_zero, self._angles_rad, self._rad_per_s = _at_zero(frames), _angles_rad(frames), rad_per_s
        self.is_parallel, self._panel = frames.geom_type == "parallel", _shape(frames)[1:]
        self.start_s = shutter.span_s * np.arange(len(self._angles_rad))
        self._middle_s = self.start_s + shutter.middle_s

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        """Returns poses (..., 12) in mm of a frame at times (...) in s: source or rays' direction, centre of pixel (0, 0),
        steps to the next column and row, x y z each."""
        angles_rad = self._angles_rad[frame] + self._rad_per_s * (np.asarray(time_s) - self._middle_s[frame])
        return poses_of_astra(_turned(self._at_zero, angles_rad.ravel()), self._panel).reshape(*angles_rad.shape, 12)


def scan_of(
    image: ImageGeometry, frames: AcquisitionGeometry, values: np.ndarray | None = None, *,
    shutter: Shutter | None = None, deg_per_s: float = 0.0,
) -> Scan:  # fmt: skip
    """Returns the scan that two geometries of CIL describe. values (F, rows, columns): line integrals; None takes zeros.
    shutter, deg_per_s, InputError: as in ``ProjectionOperator``."""
    system, is_flex = frames.config.system, frames.geom_type == "cone_flex"
    if is_flex and shutter is not None:
        raise InputError("shutter", "given for cone_flex", "a geometry with angles", "leave it out")
    if is_flex:
        pairs = zip(system.source, system.detector, strict=True)
        vectors = np.reshape([(source.position, *_panel(frames, panel)) for source, panel in pairs], (-1, 12))
    else:
        vectors = _turned(_at_zero(frames), _angles_rad(frames))
    size = image.voxel_size_z if image.voxel_num_z else image.voxel_size_x, image.voxel_size_y, image.voxel_size_x
    centre = np.array([image.center_z, image.center_y, image.center_x], np.float64)
    centre += system.volume_centre.position[::-1] if is_flex else 0.0
    values = np.broadcast_to(np.float32(0), _shape(frames)) if values is None else values
    grid = Grid(_shape(image), size, triple(centre.tolist()))
    scan = Scan.from_astra(values, vectors, grid, is_parallel=frames.geom_type == "parallel")
    if shutter is None:
        return scan
    turning = _Turning(frames, shutter, np.deg2rad(deg_per_s))
    return Scan(scan.projections, scan.geometry, turning, shutter, turning.start_s, scan.grid)


def _both(image: Any, frames: Any) -> tuple[ImageGeometry, AcquisitionGeometry]:
    if not isinstance(frames, AcquisitionGeometry):
        raise InputError("acquisition_geometry", type(frames).__name__, "CIL's AcquisitionGeometry")
    return frames.get_ImageGeometry() if image is None else image, frames


def _angles_rad(frames: AcquisitionGeometry) -> np.ndarray:
    angles = frames.config.angles
    turned = np.asarray(angles.angle_data, np.float64) + angles.initial_angle
    return np.deg2rad(turned) if angles.angle_unit == "degree" else turned


def _at_zero(frames: AcquisitionGeometry) -> np.ndarray:
    """Returns ASTRA's vectors (4, 3) at angle 0: source or ray direction, panel's middle, steps to next column and row."""
    system = frames.copy().config.system
    system.align_reference_frame("cil")
    origin = system.ray.direction if frames.geom_type == "parallel" else system.source.position
    return np.stack([np.append(vector, 0.0)[:3] for vector in (origin, *_panel(frames, system.detector))])


def _panel(frames: AcquisitionGeometry, detector: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns a panel's middle, and the steps to the next column and row of the data, x y z each. The data's first pixel is
    in the panel's corner that CIL calls its origin."""
    panel, along_y = frames.config.panel, getattr(detector, "direction_y", _FLAT)
    step_x, step_y = panel.pixel_size[0] * detector.direction_x, panel.pixel_size[1] * along_y
    return detector.position, -step_x if "right" in panel.origin else step_x, -step_y if "top" in panel.origin else step_y


def _turned(at_zero: np.ndarray, angles_rad: np.ndarray) -> np.ndarray:
    """Returns ASTRA's vectors (F, 12) for an object at angles (F,) about z: ``at_zero`` (4, 3) turned by minus the angle."""
    (x, y, z), cos, sin = at_zero.T, np.cos(angles_rad)[:, None], np.sin(angles_rad)[:, None]
    return np.stack([cos * x + sin * y, cos * y - sin * x, z + 0 * cos], -1).reshape(-1, 12)


def _mapped(
    function: Callable[[np.ndarray], np.ndarray], x: DataContainer, of: Any, to: Any, out: DataContainer | None
) -> DataContainer:
    """Applies ``function`` to each channel of the data ``x``, whose geometry is ``of``. Returns the results as data with the
    geometry ``to``, in ``out`` if given."""
    channels = np.transpose(x.as_array(), np.argsort(_places(of))).reshape(of.channels, *_shape(of))
    mapped, places = np.stack([function(np.ascontiguousarray(one)) for one in channels]), _places(to)
    out = to.allocate(None) if out is None else out
    out.fill(np.ascontiguousarray(np.transpose(mapped.reshape([to.shape[i] for i in np.argsort(places)]), places)))
    return out


def _places(geometry: Any) -> list[int]:
    """Returns, for each dimension of the geometry in CIL's order, its index in this package's order: channels, frames or
    slices, rows, columns."""
    present = [name for name in _ORDER if name in geometry.dimension_labels]
    return [present.index(name) for name in geometry.dimension_labels]


def _shape(geometry: Any) -> tuple[int, int, int]:
    """Returns an image's (slices, rows, columns), or (frames, rows, columns); 1 for a dimension that CIL leaves out."""
    if isinstance(geometry, ImageGeometry):
        return geometry.voxel_num_z or 1, geometry.voxel_num_y, geometry.voxel_num_x
    return geometry.num_projections, int(geometry.config.panel.num_pixels[1]), int(geometry.config.panel.num_pixels[0])
