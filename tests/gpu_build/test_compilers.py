"""What three compilers for GPUs say of a kernel that spills is read as that."""

import pytest
from gpu_build.compilers import KernelCost, Refused, amdgcn_costs, ocloc_costs, ptxas_costs

pytestmark = pytest.mark.slow

PTXAS = """ptxas info    : Compiling entry function 'heavy' for 'sm_90'
ptxas info    : Function properties for heavy
    16 bytes stack frame, 12 bytes spill stores, 20 bytes spill loads
ptxas info    : Used 70 registers, 1536 bytes smem, 380 bytes cmem[0]
ptxas info    : Compiling entry function 'light' for 'sm_90'
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 12 registers, 368 bytes cmem[0]
"""
AMD = """\t.amdhsa_kernel heavy
; NumVgprs: 256
; ScratchSize: 40
; Occupancy: 4
; LDSByteSize: 512 bytes/workgroup (compile time only)
"""
INTEL = """warning: kernel heavy  compiled SIMD8 allocated 128 regs and spilled around 733
Build succeeded.
"""


def test_costs() -> None:
    assert ptxas_costs(PTXAS) == [
        KernelCost("NVIDIA sm_90", "heavy", 70, 16, 1536, 28), KernelCost("NVIDIA sm_90", "light", 12, 0, 0, 64)
    ]  # fmt: skip
    assert amdgcn_costs(AMD) == [KernelCost("AMD gfx1030", "heavy", 256, 40, 512, 4)]
    assert [cost.spilled_bytes for cost in ocloc_costs(INTEL, ["heavy", "light"])] == [733, 0]


def test_an_answer_of_another_form_is_a_refusal() -> None:
    with pytest.raises(Refused):
        ocloc_costs("Build failed with error code: -11", ["heavy"])
