"""Kernels that stream over voxels, pixels or parameters compute with whole vectors, and none of their accesses to memory
is masked by one condition for all lanes. PoCL may undo either silently, and the kernel then takes 3 to 20 times as long.
`make stress`: every target, as AVX2's masks are vectors."""

import pytest
from machine_code import HERE, built, code_of
from stress import STRESSED

CHECKS = ("_algebra", "_image_terms", "_variation", "_optimiser")
"""The checks of a device whose kernels stream; their programs build quickly."""
LEAST_PACKED = 0.6  # of floating-point instructions: the rest ends a row, or is done once for a row
WIDE = 32  # bytes: LLVM prefers them with AVX-512 too, where it vectorises by itself
MAY_BE_SCALAR = {
    "dot_whole": "adds the sums of work-groups, a few numbers",
    "descend": "finds one length, by scalars, before it streams",
    "largest_parts": "runs at the start of a method only",
    **dict.fromkeys(("dct_start", "move_rows", "move_turned"), "copies, without arithmetic"),
}


@pytest.mark.parametrize("target, library, lanes", HERE if STRESSED else HERE[:1])
def test_streaming_kernels_are_packed_and_no_access_is_masked_as_one(target, library, lanes, tmp_path) -> None:
    objects, wrong = built(target, library, lanes, tmp_path, *CHECKS), {}
    for kernel, path in objects:
        code = code_of(path)
        if code.masked_as_one:
            wrong[kernel] = f"{code.masked_as_one} accesses under one condition for all lanes"
        if kernel not in MAY_BE_SCALAR and (code.packed < LEAST_PACKED * code.arithmetic or code.widest < WIDE):
            wrong[kernel] = f"{code.packed} of {code.arithmetic} operations are packed, in {code.widest} bytes at most"
    assert wrong == {} and set(MAY_BE_SCALAR) - {kernel for kernel, _ in objects} <= {"move_turned"}
    assert {"tv_dual", "tv_primal", "ridge_responses", "add_scaled", "adam_step"} <= {kernel for kernel, _ in objects}
