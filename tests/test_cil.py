"""The plug-in for CIL: geometry as CIL's own plug-ins understand it, CIL's dot test, its FISTA with TV, a gantry that turns.

Collected where CIL is installed (conftest.py)."""

import importlib
import sys
from types import ModuleType, SimpleNamespace

import cil.plugins
import numpy as np
import pytest
from cil.framework import AcquisitionGeometry, ImageGeometry
from cil.optimisation.algorithms import FISTA
from cil.optimisation.functions import LeastSquares, TotalVariation
from cil.optimisation.operators import BlockOperator, LinearOperator

from phyradgs_cl.api import Shutter
from phyradgs_cl.cil import FBP, ProjectionOperator, scan_of
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

pytestmark = pytest.mark.slow
BODY = EllipsoidPhantom((Ellipsoid((2, -3, 1), (9, 6, 7), 0.02), Ellipsoid((-4, 6, -3), (3, 4, 2), 0.05)), "body")
ANGLES = np.array([3.0, 41.0, 100.0, 187.0, 260.0, 301.0])
ALONG_X, ALONG_Y = np.array([1, 0.03, -0.02]), np.array([0.02, 0.05, 1])
TILTED = {
    "detector_direction_x": ALONG_X, "detector_direction_y": np.cross(np.cross(ALONG_X, ALONG_Y), ALONG_X),
    "rotation_axis_position": [1.5, -2.0, 0.8], "rotation_axis_direction": [0.04, -0.03, 1],
}


def _cone(**others) -> AcquisitionGeometry:
    return AcquisitionGeometry.create_Cone3D([3, -120, 2], [-4, 60, 5], **{**TILTED, **others})


def _flex() -> AcquisitionGeometry:
    turns = [np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) for a in np.deg2rad(ANGLES)]
    sets = [[turn @ v for turn in turns] for v in ([2, -120, 1], [-3, 60, 4], [1, 0, 0.02], [-0.02, 0, 1])]
    return AcquisitionGeometry.create_Cone3D_Flex(*sets, volume_centre_position=[1.0, -0.5, 0.7])


def _parallel() -> AcquisitionGeometry:
    return AcquisitionGeometry.create_Parallel3D([0.05, 1, -0.02], [1, 30, 2], **TILTED)


GEOMETRIES = {
    "cone": lambda: AcquisitionGeometry.create_Cone3D([0, -120, 0], [0, 60, 0]), "cone, every offset and tilt": _cone,
    "parallel, every offset and tilt": _parallel, "flex": _flex,
    "cone 2D": lambda: AcquisitionGeometry.create_Cone2D([2, -120], [-3, 60], [1, 0.05], [1.5, -2]),
    "parallel 2D": lambda: AcquisitionGeometry.create_Parallel2D([0.1, 1], [2, 30], [1, 0.05], [1.5, -2]),
}  # fmt: skip


def _frames(name: str, origin: str = "bottom-left", labels: list[str] | None = None) -> AcquisitionGeometry:
    frames = GEOMETRIES[name]()
    is_flat = "2D" in name
    frames.set_panel(40 if is_flat else (40, 36), 1.3 if is_flat else (1.3, 1.2), origin)
    if name != "flex":
        frames.set_angles(ANGLES, initial_angle=7.0)
    if labels:
        frames.set_labels(labels)
    return frames


def _image(frames: AcquisitionGeometry):
    is_flat = frames.dimension == "2D"
    return ImageGeometry(44, 40, 0 if is_flat else 42, 0.6, 0.7, 0.65, 0.5, -0.3, 0 if is_flat else 0.2)


@pytest.fixture
def cils_vectors(monkeypatch):
    """CIL's own conversion to ASTRA's vectors, in whose place of the package astra two functions stand."""
    named: dict[str, ModuleType] = {}
    for name, *path in (("astra",), ("cil.plugins.astra", "astra"), ("cil.plugins.astra.utilities", "astra", "utilities")):
        named[name] = ModuleType(name)
        named[name].__path__ = ["/".join((cil.plugins.__path__[0], *path))]
        monkeypatch.setitem(sys.modules, name, named[name])
    named["astra"].creators = SimpleNamespace(create_proj_geom=lambda kind, rows, columns, vectors: vectors)
    named["astra"].create_vol_geom = lambda *sizes: sizes
    path = "cil.plugins.astra.utilities.convert_geometry_to_astra_vec_3D"
    yield importlib.import_module(path).convert_geometry_to_astra_vec_3D
    del sys.modules[path]


@pytest.mark.parametrize("origin", ["bottom-left", "top-right"])
@pytest.mark.parametrize("name", GEOMETRIES)
def test_rays_are_those_of_cils_own_plug_ins(cils_vectors, name, origin) -> None:
    frames = _frames(name, origin)
    image = _image(frames)
    sizes, vectors = cils_vectors(image, frames)
    scan = scan_of(image, frames)
    used = slice(0, 9) if "2D" in name else slice(None)  # in a plane the height of a row means nothing
    np.testing.assert_allclose(scan.astra_vectors()[:, used], vectors[:, used], atol=1e-4)  # CIL adds angles in float32
    (z0, z1), (y0, y1), (x0, x1) = np.array(scan.grid.box_mm).reshape(3, 2)
    np.testing.assert_allclose([x0, x1, y0, y1], sizes[3:7])
    if "2D" not in name:
        np.testing.assert_allclose([z0, z1], sizes[7:])


@pytest.mark.parametrize("name", GEOMETRIES)
def test_projections_are_closed_forms_and_the_transpose_passes_cils_dot_test(rt, cils_vectors, name) -> None:
    frames = _frames(name)
    image = _image(frames)
    _, vectors = cils_vectors(image, frames)
    operator = ProjectionOperator(image, frames, device=rt)
    grid = scan_of(image, frames).grid
    volume = image.allocate(0)
    is_flat = "2D" in name
    fine = Grid((1, 40, 44), (0.01, 0.7, 0.6), grid.offset_mm) if is_flat else grid
    volume.fill(np.squeeze(BODY.voxelise(fine, 5)))
    columns, rows = frames.config.panel.num_pixels
    u = (np.arange(columns) - (columns - 1) / 2)[:, None]
    v = np.zeros((1, 1, 1)) if is_flat else (np.arange(rows) - (rows - 1) / 2)[:, None, None]
    expected = []
    for row in vectors:
        ends = row[3:6] + u * row[6:9] + v * row[9:]
        starts = ends - 200 * row[:3] / np.linalg.norm(row[:3]) if "parallel" in name else row[:3]
        ends = ends + 200 * row[:3] / np.linalg.norm(row[:3]) if "parallel" in name else ends
        expected.append(BODY.line_integrals(starts, ends))
    found = operator.direct(volume).as_array()
    expected = np.squeeze(expected)
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.02 * expected.max()
    assert LinearOperator.dot_test(operator, seed=1)


def test_the_order_of_dimensions_channels_blocks_and_out_follow_cil(rt) -> None:
    name = "cone, every offset and tilt"
    plain, image = _frames(name), _image(_frames(name))
    x = image.allocate("random", seed=3)
    expected = ProjectionOperator(image, plain, device=rt).direct(x)
    astra = _frames(name, labels=["vertical", "angle", "horizontal"])
    operator = ProjectionOperator(image, astra, device=rt)
    out = astra.allocate(0)
    assert operator.direct(x, out=out) is out
    np.testing.assert_array_equal(out.as_array().swapaxes(0, 1), expected.as_array())
    back = ProjectionOperator(image, plain, device=rt).adjoint(expected).as_array()
    np.testing.assert_array_equal(operator.adjoint(out).as_array(), back)
    both, images = _frames(name).set_channels(2), _image(_frames(name))
    images.channels = 2
    stacked = images.allocate(0)
    stacked.fill(np.stack([x.as_array(), 2 * x.as_array()]))
    found = ProjectionOperator(images, both, device=rt).direct(stacked).as_array()
    np.testing.assert_allclose(found, np.stack([expected.as_array(), 2 * expected.as_array()]), rtol=1e-5, atol=1e-5)
    parts = expected.partition(3, "sequential")
    blocks = ProjectionOperator(image, parts.geometry, device=rt)
    assert isinstance(blocks, BlockOperator)
    np.testing.assert_array_equal(blocks.direct(x).get_item(1).as_array(), parts.get_item(1).as_array())


def _full_turn() -> tuple[AcquisitionGeometry, object]:
    frames = AcquisitionGeometry.create_Cone3D([0, -120, 0], [0, 60, 0], rotation_axis_position=[1.5, 0, 0])
    frames.set_panel((40, 36), (1.3, 1.3)).set_angles(np.arange(60) * 6.0)
    image = frames.get_ImageGeometry()
    image.voxel_num_x = image.voxel_num_y = image.voxel_num_z = 32
    image.voxel_size_x = image.voxel_size_y = image.voxel_size_z = 0.85
    return frames, image


def _db(found, truth: np.ndarray) -> float:
    return 20 * np.log10(truth.max() / np.sqrt(np.mean((found.as_array() - truth) ** 2)))


def test_cils_fista_with_total_variation_and_fbp_find_the_phantom(rt) -> None:
    frames, image = _full_turn()
    truth = image.allocate(0)
    truth.fill(BODY.voxelise(scan_of(image, frames).grid, 5))
    operator = ProjectionOperator(image, frames, device=rt)
    data = operator.direct(truth)
    data.fill(data.as_array() + np.random.default_rng(0).normal(0, 0.01, data.shape).astype(np.float32))
    fbp = FBP(image, frames, device=rt, window="hann")(data)
    fista = FISTA(image.allocate(0), LeastSquares(operator, data), 0.1 * TotalVariation(max_iteration=20))
    fista.run(30, verbose=0)
    assert fista.objective[-1] < 0.05 * fista.objective[0]
    assert _db(fbp, truth.as_array()) > 30 and _db(fista.solution, truth.as_array()) > 40


def test_a_gantry_that_turns_averages_its_angles_line_by_line(rt) -> None:
    """Each row sees the mean of the frames of a gantry at rest, at the angles of its own exposure."""
    frames, image = _full_turn()
    truth = image.allocate(0)
    truth.fill(BODY.voxelise(scan_of(image, frames).grid, 3))
    shutter, deg_per_s = Shutter(0.25, 1.5), 24.0
    turning = {"shutter": shutter, "deg_per_s": deg_per_s}
    found = ProjectionOperator(image, frames, device=rt, **turning).direct(truth).as_array()
    still = ProjectionOperator(image, frames, device=rt).direct(truth).as_array()
    middles = deg_per_s * (np.arange(36) / 35 - 0.5) * shutter.readout_s
    expected = np.zeros_like(still)
    for row in range(36):
        for late in (np.arange(9) - 4) / 9 * shutter.exposure_s * deg_per_s:
            turned = frames.copy().set_angles(np.arange(60) * 6.0 + middles[row] + late)
            if row % 5 == 0:
                expected[:, row] += ProjectionOperator(image, turned, device=rt).direct(truth).as_array()[:, row] / 9
    rows = slice(0, None, 5)
    off, blurred = (np.sqrt(np.mean((one - expected)[:, rows] ** 2)) for one in (found, still))
    assert off < 0.1 * blurred, (off, blurred)
    known, ignored = (FBP(image, frames, device=rt, window="hann", **way) for way in (turning, {}))
    data = frames.allocate(0) + found
    assert _db(known(data), truth.as_array()) > _db(ignored(data), truth.as_array()) + 1


def test_wrong_geometries_are_refused(rt) -> None:
    frames, image = _full_turn()
    with pytest.raises(InputError, match="acquisition_geometry: found NoneType"):
        ProjectionOperator(image)
    with pytest.raises(InputError, match="data: found another geometry"):
        FBP(image, frames, device=rt)(frames.copy().set_angles(np.arange(60) * 3.0).allocate(0))
    with pytest.raises(InputError, match="shutter: given for cone_flex"):
        ProjectionOperator(image, _frames("flex"), shutter=Shutter(1.0), device=rt)
