"""The command devices: lists the OpenCL devices and says which one is used; --check compares its kernels with float64."""

import time
from typing import Annotated

from phyradgs_cl.commands.console import option, say
from phyradgs_cl.commands.options import Device
from phyradgs_cl.device_check import check_device
from phyradgs_cl.device_probes import probe_lines
from phyradgs_cl.errors import DeviceError
from phyradgs_cl.runtime import choose_device, known_fault, list_devices
from phyradgs_cl.runtime.context import default_lanes

EXAMPLES = {"devices": "Example: phyradgs devices --device cpu"}
_CHECK = "Run every kernel on the device and compare it with float64."


def devices_command(check: Annotated[bool, option(_CHECK)] = False, device: Device = None) -> int:
    """List the OpenCL devices and the one that is used, with the reason; --check runs every kernel on it."""
    chosen, reason = choose_device(device)
    if check:
        started = time.perf_counter()
        verdict = check_device(device)
        say(str(verdict))
        if fault := known_fault(chosen):
            say(f"  known: {fault}")
        for line in probe_lines(device, verdict.group_limits, time.perf_counter() - started):
            say(f"  {line}")
        return DeviceError.exit_code if verdict.failures else 0
    for d in list_devices():
        mark = "*" if d.index == chosen.index else " "
        by_name = "" if d.by_default else ", only by --device"
        say(
            f"{mark} {d.index}: {d.name} ({d.kind}; {d.platform}), {d.compute_units} units, vector width {default_lanes(d)} "
            f"of {d.vector_width}, {d.memory_bytes / 2**30:.1f} GiB, at most {d.largest_allocation_bytes / 2**30:.1f} GiB "
            f"in one buffer, float64 {'yes' if d.has_fp64 else 'no'}{by_name}"
        )
        say(f"     {d.version}" + (f", kernels built for {d.target}" if d.target else ""))
    say(f"takes {chosen.index}: {reason}")
    return 0
