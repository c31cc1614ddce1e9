"""Devices, programs, buffers and launches. Only this folder imports pyopencl."""

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
    bytes_of,
    is_cl_array,
    lent,
    with_smaller_bricks,
)
from phyradgs_cl.runtime.opencl import Kernel
from phyradgs_cl.runtime.profile import KernelUse, Rates, profile_text

__all__ = [
    "DEVICE_VARIABLE", "MEMORY_VARIABLE", "Array", "DeviceArray", "DeviceInfo", "DeviceSpace",
    "HostSpace", "Kernel", "KernelUse", "LaterItem", "MemoryShortage", "Rates", "Room", "Runtime",
    "SameArray", "Space", "Traffic", "adopted", "bytes_of", "choose_device", "is_cl_array", "known_fault",
    "lent", "list_devices", "profile_text", "with_smaller_bricks",
]  # fmt: skip
