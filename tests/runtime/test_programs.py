"""Programs and kernels: built once, sources with their headers, errors that name the file and line."""


import numpy as np
import pytest
from kernel_kit import assert_near, frame_cells, splat, splat_gradients
from tolerances import FLOAT32

from phyradgs_cl import resource
from phyradgs_cl.acquisition import ConeGeometry
from phyradgs_cl.errors import DeviceError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import Voxeliser
from phyradgs_cl.runtime import Runtime, context
from phyradgs_cl.runtime import opencl as sources
from phyradgs_cl.runtime.context import default_lanes
from phyradgs_cl.runtime.opencl import kernel_source

PROGRAMS = sorted(path.stem for path in resource("cl").glob("*.cl"))


def test_programs_are_built_once_for_all_their_kernels(monkeypatch) -> None:
    """And again for other defines."""
    built: list[str] = []
    build = Runtime._build
    monkeypatch.setattr(Runtime, "_build", lambda rt, name, how: built.append(name) or build(rt, name, how))
    rt = Runtime()
    for name in 3 * ("bin_count", "bin_within", "bin_starts", "bin_fill"):
        kernel = rt.kernel("binning", name)
        assert kernel.built is None or built, "a declaration alone builds nothing"
        assert rt.compile(kernel) and rt.kernel("binning", name) is kernel
    assert built == ["binning"]
    exact, affine = (rt.kernel("splat_prepare", "splat_prepare", AFFINE=a, IMAGE_GUARD=16) for a in (0, 1))
    assert exact is not affine
    assert rt.kernel("splat_prepare", "splat_prepare", IMAGE_GUARD=16, AFFINE=0) is exact


@pytest.mark.parametrize("program", PROGRAMS)
def test_headers_are_pasted_once_with_line_marks(program) -> None:
    """Every line of the pasted text is that line of that file; a header's second mention leaves an empty one."""
    lines, name, number = kernel_source(program).splitlines(), "", 0
    marks = [line for line in lines if line.startswith("#line")]
    assert marks[0] == f'#line 1 "{program}.cl"'
    opened = [mark for mark in marks if mark.startswith("#line 1 ")]
    assert len(set(opened)) == len(opened)
    for line in lines:
        assert "#include" not in line
        if line.startswith("#line"):
            _, first, quoted = line.split()
            name, number = quoted.strip('"'), int(first)
            continue
        written = (resource("cl") / name).read_text().splitlines()[number - 1]
        assert line == ("" if written.startswith("#include") else written), f"{name}:{number}"
        number += 1


def test_a_build_error_names_file_and_line(rt, tmp_path, monkeypatch) -> None:
    """In a folder with a space in its path; of a header too."""
    folder, nothing = tmp_path / "with space" / "cl", "__kernel void nothing(__global float *x) { x[0] = %s; }\n"
    (folder / "common").mkdir(parents=True)
    for name, text in {
        "common/broken.h": "inline float good(float x) { return x; }\n\nthis is not C;\n",
        "uses_broken.cl": f'/* a comment */\n#include "common/broken.h"\n{nothing % "good(x[0])"}',
        "breaks_later.cl": f'#include "common/fine.h"\n{nothing % "unknown_thing"}',
        "common/fine.h": "inline float fine(float x) { return x; }\n",
    }.items():
        (folder / name).write_text(text)
    monkeypatch.setattr(sources, "resource", lambda name: folder)
    for program, place in {"uses_broken": "common/broken.h:3", "breaks_later": "breaks_later.cl:2"}.items():
        with pytest.raises(DeviceError) as raised:
            rt.launch(rt.kernel(program, "nothing"), 1, rt.zeros(1))
        assert all(word in str(raised.value) for word in (f"{program}.cl", place, rt.device.name))


def test_errors_that_name_no_file_are_placed() -> None:
    """NVIDIA's compiler ignores #line, and counts lines of the pasted text."""
    source = '#line 1 "a.cl"\nint a;\n#line 1 "common/b.h"\nint b;\nthis is not C;\n#line 3 "a.cl"\nint c;'
    log = "<kernel>:5:1: error: unknown type name 'this'\nnot C;\n^\n<kernel>:7:5: error: no\n<kernel>:99:1: error: end"
    expected = ["common/b.h:2:1: error: unknown type name 'this'", "a.cl:3:5: error: no", "a.cl:3:1: error: end"]
    assert sources.placed_errors(log, source) == expected
    own = "error: a.cl:2:79: use of undeclared identifier 'u'"
    assert sources.placed_errors(f"Build on <device>:\n\n{own}\n", source) == [own]


def test_pairs_of_floats_are_built_without_multiply_adds(monkeypatch) -> None:
    """Where a driver ignores the pragma, the option alone would break their sums. Others keep the option."""
    built: dict[str, list[str]] = {}
    real = context.cl.Program

    class Noted:
        def __init__(self, at: object, source: str) -> None:
            self.source, self.program = source, real(at, source)

        def build(self, options: list[str]) -> object:
            built[self.source] = options
            return self.program.build(options=options)

    monkeypatch.setattr(context.cl, "Program", Noted)
    for fp64 in (False, True):
        rt = Runtime(fp64=fp64)
        for program, name in (("algebra", "dot_parts"), ("voxel_prepare", "voxel_prepare"), ("adam", "adam_step")):
            rt.compile(rt.kernel(program, name, IMAGE_GUARD=16))
            has_pairs = program != "adam" and not fp64
            assert ("-cl-mad-enable" not in built[kernel_source(program)]) == has_pairs, (program, fp64)


def test_products_that_kernels_share_are_rounded(monkeypatch) -> None:
    """Where rays of parallel beams start: fused into a sum in one kernel alone, forward and adjoint would differ."""
    asked = "__kernel void at(const float s, const float g, __global float *out) { out[0] = START_OF(s, 3) + g; }"
    monkeypatch.setattr(context, "kernel_source", lambda name: kernel_source(name) + asked)
    rt, (s, g) = Runtime(), np.array([0.1, -0.3], np.float32)
    out = rt.zeros(1)
    rt.launch(rt.kernel("rays", "at", IMAGE_GUARD=16, RAY_LONG=0, RAY_PARALLEL=1), 1, s, g, out)
    fused = np.float32(3 * float(s) + float(g))
    assert rt.download(out)[0] == np.float32(s * np.float32(3)) + g != fused


@pytest.mark.slow
def test_splats_and_voxels_where_the_smallest_numbers_are_0(monkeypatch, make_cloud) -> None:
    """Small whole numbers are subnormal as floats: in records of floats, whole splats would be left out."""
    rows, grid, shape = make_cloud(20, 3), Grid((9, 10, 11), (0.2, 0.2, 0.2)), (12, 20)
    table = frame_cells("static", ConeGeometry(5.0, 7.5, shape, (0.3, 0.2)))

    def computed(rt: Runtime) -> list[np.ndarray]:
        gradients = splat_gradients(rt, rows, table, np.ones(shape))
        return [splat(rt, rows, table, shape), gradients, Voxeliser(rt, grid.shape).voxelise(rows, grid)]

    usual = computed(Runtime(lanes=1, pixel_items=True))
    allowed = Runtime._allowed
    flushing = staticmethod(lambda *given: [*allowed(*given), "-cl-denorms-are-zero"])
    monkeypatch.setattr(Runtime, "_allowed", flushing)
    for found, expected in zip(computed(Runtime(lanes=1, pixel_items=True)), usual, strict=True):
        assert_near(found, expected, FLOAT32)


def test_lanes_follow_the_device_and_can_be_told_and_too_large_arrays_are_refused(rt) -> None:
    assert rt.lanes == (1 if rt.pixel_items else default_lanes(rt.device))
    assert Runtime(lanes=4, pixel_items=False).lanes == 4 and Runtime(fp64=False).fp64 is False
    for wrong in ({"lanes": 3}, {"lanes": 4, "pixel_items": True}):
        with pytest.raises(DeviceError, match="lanes"):
            Runtime(**wrong)
    with pytest.raises(DeviceError, match="MiB"):
        rt.empty(rt.device.largest_allocation_bytes)  # four times that in bytes
