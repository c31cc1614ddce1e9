"""Whether a device can be trusted: every kernel is asked, and one that is wrong is named."""

import re
from pathlib import Path

import pytest
from kernel_kit import CPU_ONLY

from phyradgs_cl import device_check
from phyradgs_cl.device_check import check_device
from phyradgs_cl.runtime import context
from phyradgs_cl.runtime.opencl import kernel_source

KERNELS = Path(__file__).resolve().parent.parent / "cl"
GPU_ONLY = {"splat_forward_pixels", "splat_backward_group"}
GPU_ONLY |= {"bin_count_group", "bin_within_group", "bin_starts_group", "bin_fill_group"}
GPU_ONLY |= {"warp_adjoint_fixed", "warp_adjoint_sum"}
SHAPES = {"CPU": ({"pixel_items": False}, GPU_ONLY), "GPU": ({"lanes": 1, "pixel_items": True}, CPU_ONLY)}


@pytest.mark.parametrize(("launch_shape", "others"), SHAPES.values(), ids=SHAPES)
def test_every_kernel_is_asked(launch_shape, others) -> None:
    sources = (path.read_text(encoding="utf-8") for path in KERNELS.glob("*.cl"))
    known = {name for text in sources for name in re.findall(r"__kernel\s+void\s+(\w+)", text)}
    verdict = check_device(**launch_shape)
    assert verdict.failures == () and known - verdict.agreeing == others
    assert str(verdict).endswith(f"can be trusted: all {len(verdict.agreeing)} kernels agree with float64")


# a check, a program, what is changed in it, and what the line says
WRONG = [
    ("_optimiser", "adam", "sqrt(v) + epsilon", "sqrt(m * m) + epsilon", ": adam_step (off by"),
    ("_binning", "binning", "tile_splat_ids[position] = g;", "tile_splat_ids[position] = 0;", "bin_fill"),
    ("_voxels", "voxel_backward", "__kernel void voxel_chain(", "nonsense", "kernel voxel_backward.cl on"),
]


@pytest.mark.parametrize(("check", "program", "right", "wrong", "named"), WRONG)
def test_a_wrong_kernel_is_named(monkeypatch, cli, capfd, check, program, right, wrong, named) -> None:
    def planted(name: str) -> str:
        source = kernel_source(name)
        if name != program:
            return source
        assert right in source
        return source.replace(right, wrong)

    monkeypatch.setattr(context, "kernel_source", planted)
    monkeypatch.setattr(device_check, "CHECKS", (getattr(device_check, check),))
    assert cli.run(["devices", "--check"]) == 5
    line = capfd.readouterr().out
    assert line.count("\n") == 1 and "cannot be trusted: " in line and named in line
