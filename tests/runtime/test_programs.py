"""Programs and kernels: built once, sources with their headers, errors that name the file and line."""

from __future__ import annotations

import numpy as np
import pytest

from phyradgs_cl.errors import DeviceError
from phyradgs_cl.resources import resource
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime import source as sources
from phyradgs_cl.runtime.context import default_lanes
from phyradgs_cl.runtime.source import kernel_source

PROGRAMS = sorted(path.stem for path in resource("cl").glob("*.cl"))


def test_a_kernel_is_built_once(rt) -> None:
    first = rt.kernel("adam", "adam_step")
    assert rt.kernel("adam", "adam_step") is first
    assert rt.kernel("adam", "activate") is not first
    assert rt.compile(rt.kernel("adam", "activate")).program == rt.compile(first).program


def test_defines_are_told_apart(rt) -> None:
    exact, affine = (rt.kernel("splat_prepare", "splat_prepare", AFFINE=a, IMAGE_GUARD=16) for a in (0, 1))
    assert exact is not affine
    assert rt.kernel("splat_prepare", "splat_prepare", IMAGE_GUARD=16, AFFINE=0) is exact


def test_programs_are_built_once_for_all_their_kernels(rt, monkeypatch) -> None:
    built: list[str] = []
    build = Runtime._build
    monkeypatch.setattr(
        Runtime,
        "_build",
        lambda self, program, options: built.append(program) or build(self, program, options),
    )
    runtime = Runtime()
    for _ in range(3):
        for name in ("bin_count", "bin_within", "bin_starts", "bin_fill"):
            kernel = runtime.kernel("binning", name)
            assert kernel.built is None or built, "a declaration alone builds nothing"
            runtime.compile(kernel)
    assert built == ["binning"]


@pytest.mark.parametrize("program", PROGRAMS)
def test_headers_are_pasted_once_with_line_marks(program) -> None:
    text = kernel_source(program)
    assert "#include" not in text
    marks = [line for line in text.splitlines() if line.startswith("#line")]
    assert marks[0] == f'#line 1 "{program}.cl"'
    opened = [mark for mark in marks if mark.startswith("#line 1 ")]
    assert len(set(opened)) == len(opened)


@pytest.mark.parametrize("program", PROGRAMS)
def test_line_marks_count_the_lines_of_their_file(program) -> None:
    """Every line of the pasted text is that line of that file; a header's second mention leaves an empty one."""
    name, number = "", 0
    for line in kernel_source(program).splitlines():
        if line.startswith("#line"):
            _, first, quoted = line.split()
            name, number = quoted.strip('"'), int(first)
            continue
        written = (resource("cl") / name).read_text().splitlines()[number - 1]
        assert line == ("" if written.startswith("#include") else written), f"{name}:{number}"
        number += 1


@pytest.fixture
def broken_folder(tmp_path, monkeypatch):
    """A ``cl`` folder (with a space in its path) whose header has an error on its third line."""
    folder = tmp_path / "with space" / "cl"
    (folder / "common").mkdir(parents=True)
    (folder / "common" / "broken.h").write_text(
        "inline float good(float x) { return x; }\n\nthis is not C;\n"
    )
    (folder / "uses_broken.cl").write_text(
        '/* a comment */\n#include "common/broken.h"\n__kernel void nothing(__global float *x) { x[0] = good(x[0]); }\n'
    )
    (folder / "breaks_later.cl").write_text(
        '#include "common/fine.h"\n__kernel void nothing(__global float *x) { x[0] = unknown_thing; }\n'
    )
    (folder / "common" / "fine.h").write_text("inline float fine(float x) { return x; }\n")
    monkeypatch.setattr(sources, "resource", lambda name: folder)


@pytest.mark.parametrize(
    ("program", "place"), [("uses_broken", "common/broken.h:3"), ("breaks_later", "breaks_later.cl:2")]
)
def test_a_build_error_names_file_and_line(rt, broken_folder, program, place) -> None:
    with pytest.raises(DeviceError) as raised:
        rt.launch(rt.kernel(program, "nothing"), 1, rt.zeros(1))
    text = str(raised.value)
    assert f"{program}.cl" in text and place in text and rt.device.name in text


def test_lanes_follow_the_device_and_can_be_told(rt) -> None:
    assert rt.lanes == default_lanes(rt.device)
    assert Runtime(lanes=4).lanes == 4
    with pytest.raises(DeviceError, match="lanes"):
        Runtime(lanes=3)
    assert Runtime(fp64=False).fp64 is False


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(DeviceError, match="no such device"):
        Runtime("no such device")


@pytest.mark.parametrize("dtype", [np.float32, np.int32, np.float64])
def test_memory_keeps_what_it_is_given(rt, dtype) -> None:
    values = np.arange(24, dtype=dtype).reshape(2, 3, 4)
    array = rt.upload(values)
    assert array.shape == (2, 3, 4) and array.dtype == dtype and array.nbytes == values.nbytes
    np.testing.assert_array_equal(rt.download(array), values)
    assert rt.read_item(array, 7) == 7
    other = rt.zeros((2, 3, 4), dtype)
    np.testing.assert_array_equal(rt.download(other), 0)
    rt.copy(array, other)
    np.testing.assert_array_equal(rt.download(other), values)
    rt.fill(other, 3)
    np.testing.assert_array_equal(rt.download(other), 3)


def test_empty_arrays_are_allowed(rt) -> None:
    assert rt.download(rt.upload(np.zeros((0, 3), np.float32))).shape == (0, 3)


def test_too_much_memory_is_refused_in_words(rt) -> None:
    with pytest.raises(DeviceError, match="MiB"):
        rt.empty(rt.device.largest_allocation_bytes)  # four times that in bytes


def test_profiles_add_up_by_kernel() -> None:
    runtime = Runtime(profile=True)
    runtime.zeros(1000)
    runtime.launch(runtime.kernel("binning", "bin_starts"), 1, np.int32(2), runtime.zeros(3, np.int32))
    seconds = runtime.kernel_seconds()
    assert set(seconds) == {"fill", "bin_starts"}
    assert all(0 <= s < 10 for s in seconds.values())
    assert runtime.kernel_seconds() == {}
