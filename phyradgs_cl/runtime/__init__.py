"""OpenCL devices, programs, buffers and launches. Only this folder imports pyopencl."""

from phyradgs_cl.runtime.algebra import DeviceSpace, HostSpace, Space
from phyradgs_cl.runtime.context import Runtime
from phyradgs_cl.runtime.device import DEVICE_VARIABLE, DeviceInfo, choose_device, known_fault, list_devices
from phyradgs_cl.runtime.memory import (
    MEMORY_VARIABLE,
    Array,
    DeviceArray,
    LaterItem,
    MemoryShortage,
    Room,
    SameArray,
    Traffic,
    adopted,
    attempts,
    bytes_of,
    is_cl_array,
    lent,
)
from phyradgs_cl.runtime.opencl import Kernel
from phyradgs_cl.runtime.profile import KernelUse, Rates, profile_text

__all__ = [
    "DEVICE_VARIABLE", "MEMORY_VARIABLE", "Array", "DeviceArray", "DeviceInfo", "DeviceSpace",
    "HostSpace", "Kernel", "KernelUse", "LaterItem", "MemoryShortage", "Rates", "Room", "Runtime",
    "SameArray", "Space", "Traffic", "adopted", "attempts", "bytes_of", "choose_device", "is_cl_array", "known_fault",
    "lent", "list_devices", "profile_text",
]  # fmt: skip
