"""The only room that knows OpenCL: devices, programs, buffers, launches."""

from phyradgs_cl.runtime.context import DeviceArray, Runtime
from phyradgs_cl.runtime.device import DEVICE_VARIABLE, DeviceInfo, choose_device, list_devices
from phyradgs_cl.runtime.profile import KernelUse, Rates, profile_text

__all__ = [
    "DEVICE_VARIABLE",
    "DeviceArray",
    "DeviceInfo",
    "KernelUse",
    "Rates",
    "Runtime",
    "choose_device",
    "list_devices",
    "profile_text",
]
