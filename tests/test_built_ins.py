"""Built-in functions are inlined: no object that PoCL has built calls one. `make stress`: every target."""

import os
import re
from pathlib import Path

import pytest
from machine_code import HERE, built
from stress import STRESSED

from phyradgs_cl.runtime import pocl

pytestmark = pytest.mark.slow

LONG_FUNCTIONS = {"log1p", "expm1"}  # of many instructions: a call costs little in comparison


@pytest.mark.parametrize("target, library, lanes", HERE if STRESSED else HERE[:1])
def test_no_kernel_calls_a_built_in_function(target, library, lanes, tmp_path) -> None:
    pocl.prepare_environment()
    own = None if STRESSED else Path(os.environ[pocl.CACHE_VARIABLE])  # tests/test_device_check.py builds the same there
    objects = built(target, library, lanes, tmp_path, cache=own)
    assert len(objects) > 50
    calls = {
        (kernel, name.decode())
        for kernel, path in objects
        for name in re.findall(rb"_Z[0-9]+_cl_([a-z0-9_]+?)(?:Dv|[A-Z]|[a-z]\0|\0)", path.read_bytes())
    }
    assert {call for call in calls if call[1] not in LONG_FUNCTIONS} == set()
