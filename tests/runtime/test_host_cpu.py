"""The processor's name, which a results file carries beside its seconds."""

import platform

from phyradgs_cl.runtime.pocl import cpu_facts, cpu_name

_TWO_CORES = """processor\t: 0
cpu family\t: 25
model\t\t: 17
model name\t: AMD EPYC
flags\t\t: fpu vme avx512f

processor\t: 1
cpu family\t: 99
model name\t: another
"""


def test_first_processor_is_named_with_what_tells_generations_apart(tmp_path):
    described = tmp_path / "cpuinfo"
    described.write_text(_TWO_CORES)
    facts = cpu_facts(described)
    assert facts["flags"].split() == ["fpu", "vme", "avx512f"]
    assert cpu_name(facts) == "AMD EPYC, family 25 model 17"


def test_without_a_description_the_name_is_python_s(tmp_path):
    facts = cpu_facts(tmp_path / "no such file")
    assert facts == {}
    assert cpu_name(facts) == (platform.processor() or platform.machine())
    assert cpu_name({"model name": "Cortex"}) == cpu_name({"model name": "Cortex", "model": "1"}) == "Cortex"
