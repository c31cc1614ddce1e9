"""Whether a device can be trusted: every kernel is asked, and one that is wrong is named."""

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from kernel_kit import CPU_ONLY, launches
from remembered import remembered

from phyradgs_cl import device_check, device_probes
from phyradgs_cl.device_check import check_device
from phyradgs_cl.device_probes import probe_lines
from phyradgs_cl.errors import DeviceError
from phyradgs_cl.runtime import Runtime, context, known_fault
from phyradgs_cl.runtime.device import warn_of_fault
from phyradgs_cl.runtime.opencl import kernel_source

pytestmark = pytest.mark.slow

KERNELS = Path(__file__).resolve().parent.parent / "cl"
GPU_ONLY = {
    "splat_forward_pixels", "splat_backward_group", "bin_count_group", "bin_within_group", "bin_starts_group",
    "bin_fill_group", "warp_adjoint_fixed", "warp_adjoint_sum",
}  # fmt: skip
TWINS = ("splat_frame", "moving_frame", "splat_image", "deformed_frame", "voxel_field")
LONG = {  # kernels that may take long
    "rays_forward", "rays_adjoint", "backproject", "backproject_lines", "backproject_moving", "backproject_lines_moving",
    "push_displacement", "splat_forward_pixels", "splat_backward_group", "voxel_forward", "voxel_backward", "warp_forward",
    "warp_adjoint_fixed", "dct_excess", "ridge_responses",
}  # fmt: skip


@pytest.fixture(scope="module")
def twins_once() -> Iterator[None]:
    """Central differences of the twins are most of a check's time, and the same whatever shape launches have."""
    with pytest.MonkeyPatch.context() as patch:
        for name in TWINS:
            patch.setattr(device_check, name, remembered(getattr(device_check, name)))
        yield


def known_kernels() -> set[str]:
    sources = (path.read_text(encoding="utf-8") for path in KERNELS.glob("*.cl"))
    return {name for text in sources for name in re.findall(r"__kernel\s+void\s+(\w+)", text)}


def test_every_kernel_is_asked(twins_once) -> None:
    verdict = check_device(pixel_items=False)
    assert verdict.failures == () and known_kernels() - verdict.agreeing == GPU_ONLY
    assert str(verdict).endswith(f"can be trusted: all {len(verdict.agreeing)} kernels agree with float64")


def test_groups_and_launches_keep_to_small_limits(twins_once, monkeypatch) -> None:
    """A kernel with many registers may allow fewer items than its device. Here all do, and no launch may be long, on a GPU
    without doubles. With doubles, and in other shapes: the tests of kernels. Not optimised, builds take half as long."""
    parts, allowed = launches(monkeypatch), Runtime._allowed
    monkeypatch.setattr(Runtime, "_allowed", staticmethod(lambda *given: [*allowed(*given), "-cl-opt-disable"]))
    monkeypatch.setattr(Runtime, "_asked", lambda *_: 32)
    monkeypatch.setattr(Runtime, "most_samples", 50)
    verdict = check_device(lanes=1, pixel_items=True, fp64=False)
    assert verdict.failures == () and known_kernels() - verdict.agreeing == CPU_ONLY
    assert max(math.prod(group) for _, _, group, _ in parts) == 32
    assert {name for name, _, _, first in parts if first is not None} >= LONG


# a check, a program, what is changed in it, and what the line says
WRONG = [
    ("_optimiser", "adam", "sqrt(v) + epsilon", "sqrt(m * m) + epsilon", ": adam_step (off by"),
    ("_binning", "binning", "tile_splat_ids[position] = g;", "tile_splat_ids[position] = 0;", "bin_fill"),
    ("_voxels", "voxel_backward", "__kernel void voxel_chain(", "nonsense", "kernel voxel_backward.cl on"),
]


@pytest.mark.parametrize(("check", "program", "right", "wrong", "named"), WRONG)
def test_a_wrong_kernel_is_named(monkeypatch, cli, capfd, check, program, right, wrong, named) -> None:
    def planted(name: str) -> str:
        return kernel_source(name).replace(right, wrong) if name == program else kernel_source(name)

    assert right in kernel_source(program)
    monkeypatch.setattr(context, "kernel_source", planted)
    monkeypatch.setattr(device_check, "CHECKS", (getattr(device_check, check),))
    assert cli.run(["devices", "--check"]) == 5
    line, *probes = capfd.readouterr().out.splitlines()
    assert "cannot be trusted: " in line and named in line
    told = [word for probe in probes if (word := probe.partition(":")[0].split()[0]) != "longest"]  # asked of GPUs
    assert told == ["driver", "pairs", "whole", "subnormal", "work-items", "times"]


def test_what_a_device_does_with_numbers_is_told(monkeypatch) -> None:
    """A build that may reorder sums stands for a driver that contracts pairs."""
    monkeypatch.setattr(device_probes, "LASTING_S", (0.01,))
    asked = None, {"wide": 256, "narrow": 64}, 1.5
    right = list(probe_lines(*asked, lanes=1, pixel_items=True, fp64=False))
    assert "which stand for float64 here: kept" in right[1] and "kept, as floats kept" in right[2]
    assert "of narrow at most 64" in right[4] and "compared in 1.5 s" in right[5]
    assert re.search(r"longest launch that lived: [\d.e-]+ s or more", right[6])
    allowed = Runtime._allowed
    monkeypatch.setattr(Runtime, "_allowed", staticmethod(lambda *given: [*allowed(*given), "-cl-fast-relaxed-math"]))
    if "rusticl" in right[0]:  # which ignores the option
        return
    assert "pairs of floats: contracted, relative error 5.9e-08" in list(probe_lines(*asked))[1]
    monkeypatch.setattr(device_check, "CHECKS", (device_check._numbers,))
    assert "probe_pairs (off by" in check_device(fp64=False).failures[0] and not check_device().failures


def test_a_driver_that_ends_long_launches_is_found(monkeypatch) -> None:
    made = []

    def spin(rt: Runtime, steps: int) -> float:
        made.append(rt)
        if 1e-5 * steps > 2:
            raise DeviceError("device", "ended", "one that works")
        return 1e-5 * steps

    monkeypatch.setattr(device_probes, "_spin", spin)
    found = device_probes.longest_launch(lambda: Runtime(), (0.1, 1.0, 3.0))
    assert found == "1 s; the driver ended one of 3 s" and len(set(made)) == 4


def test_a_driver_that_is_known_to_be_wrong_is_named(monkeypatch, cli, rt, capfd, caplog) -> None:
    monkeypatch.setattr(device_check, "CHECKS", (device_check._numbers,))
    assert cli.run(["devices", "--check"]) == 0 and "known:" not in capfd.readouterr().out

    class Old:
        driver_version = "22.3.6"

        def __getattr__(self, name: str) -> object:
            return getattr(rt.device.handle, name)

    old = replace(rt.device, platform="rusticl", handle=Old())
    assert "install Mesa 25 or newer" in known_fault(old)
    for _ in range(2):
        warn_of_fault(old)
    assert caplog.text.count("rusticl of Mesa 22.3.6 computes wrong sums") == 1
    Old.driver_version = "25.0.7-2"
    assert known_fault(old) is None
    monkeypatch.setattr("phyradgs_cl.commands.devices.known_fault", lambda device: "wrong sums")
    cli.run(["devices", "--check"])
    assert "  known: wrong sums\n" in capfd.readouterr().out
