"""devices: what OpenCL offers, and what would be taken."""

from phyradgs_cl.commands.console import say
from phyradgs_cl.commands.options import Device
from phyradgs_cl.runtime import choose_device, list_devices
from phyradgs_cl.runtime.context import default_lanes
from phyradgs_cl.settings import device_wish

EXAMPLE = "Example: phyradgs devices --device cpu"


def devices_command(device: Device = None) -> None:
    """List OpenCL devices and say which one is taken, and why."""
    chosen, reason = choose_device(device_wish(device))
    for d in list_devices():
        mark = "*" if d.index == chosen.index else " "
        never = "" if d.by_default else ", only when asked for"
        say(
            f"{mark} {d.index}: {d.name} ({d.kind}; {d.platform}), {d.compute_units} units, vector width {default_lanes(d)} "
            f"of {d.vector_width}, {d.memory_bytes / 2**30:.1f} GiB, at most {d.largest_allocation_bytes / 2**30:.1f} GiB "
            f"at once, float64 {'yes' if d.has_fp64 else 'no'}{never}"
        )
        say(f"     {d.version}")
    say(f"takes {chosen.index}: {reason}")
