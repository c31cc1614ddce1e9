"""The only room that knows OpenCL: devices, programs, buffers, launches."""

from phyradgs_cl.runtime.context import Runtime
from phyradgs_cl.runtime.device import DEVICE_VARIABLE, DeviceInfo, choose_device, list_devices
from phyradgs_cl.runtime.kernel import Kernel
from phyradgs_cl.runtime.memory import (
    MEMORY_VARIABLE,
    DeviceArray,
    MemoryShortage,
    Room,
    adopted,
    bytes_of,
    is_cl_array,
    lent,
    with_smaller_bricks,
)
from phyradgs_cl.runtime.profile import KernelUse, Rates, profile_text

__all__ = [
    "DEVICE_VARIABLE",
    "MEMORY_VARIABLE",
    "DeviceArray",
    "DeviceInfo",
    "Kernel",
    "KernelUse",
    "MemoryShortage",
    "Rates",
    "Room",
    "Runtime",
    "adopted",
    "bytes_of",
    "choose_device",
    "is_cl_array",
    "lent",
    "list_devices",
    "profile_text",
    "with_smaller_bricks",
]
