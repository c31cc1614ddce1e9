"""Which device is taken: by capability, by wish, by environment; never a checker or an emulator unasked."""

import re
from types import SimpleNamespace

import pyopencl as cl
import pytest

from phyradgs_cl.errors import DeviceError
from phyradgs_cl.runtime import device as devices
from phyradgs_cl.runtime.device import DEVICE_VARIABLE, choose_device, list_devices


def fake_device(name: str, kind: str = "cpu", **changes: object) -> SimpleNamespace:
    types = {"cpu": cl.device_type.CPU, "gpu": cl.device_type.GPU, "accelerator": cl.device_type.ACCELERATOR}
    facts = {
        "name": name, "version": "OpenCL 3.0", "type": types[kind], "available": True, "compiler_available": True,
        "max_compute_units": 8, "global_mem_size": 1 << 33, "max_mem_alloc_size": 1 << 31, "extensions": "",
        "native_vector_width_float": 8, "native_vector_width_double": 4, "host_unified_memory": kind == "cpu",
        "int_ptr": 0,
    }  # fmt: skip
    return SimpleNamespace(**(facts | changes))


def fake_platform(name: str, *found: SimpleNamespace, vendor: str = "") -> SimpleNamespace:
    return SimpleNamespace(name=name, vendor=vendor, get_devices=lambda: list(found))


OCLGRIND = fake_platform("Oclgrind", fake_device("Oclgrind Simulator", "gpu", max_compute_units=999))
FAST = {"native_vector_width_float": 16, "max_compute_units": 999}
FPGA = fake_platform(
    "Intel(R) FPGA Emulation Platform for OpenCL(TM)",
    fake_device("Intel(R) FPGA Emulation Device", "accelerator", **FAST),
)
EMULATOR = fake_platform("Other", fake_device("Some Emulator", "gpu"))
CPU = fake_platform("Some CPU runtime", fake_device("EPYC", native_vector_width_float=16))
GPU = fake_platform("Some GPU runtime", fake_device("H200", "gpu", native_vector_width_float=1))
INTEGRATED = fake_platform("Integrated", fake_device("UHD", "gpu", host_unified_memory=True))


@pytest.fixture
def machine(monkeypatch):
    """Puts platforms into the machine, in the order in which OpenCL would name them."""
    monkeypatch.delenv(DEVICE_VARIABLE, raising=False)

    def install(*platforms: SimpleNamespace) -> None:
        monkeypatch.setattr(devices.cl, "get_platforms", lambda: list(platforms))

    return install


def test_which_device_is_taken_by_capability_by_kind_by_part_of_a_name_and_by_index(machine) -> None:
    half = fake_platform("Half", fake_device("no compiler", "gpu", compiler_available=False))
    for chosen, wish, *platforms in [
        ("EPYC", None, FPGA, OCLGRIND, EMULATOR, CPU), ("EPYC", None, half, CPU), ("H200", None, CPU, GPU),
        ("H200", None, OCLGRIND, INTEGRATED, GPU, CPU), ("UHD", None, CPU, INTEGRATED), ("EPYC", "epyc", CPU, GPU),
        ("H200", "gpu", OCLGRIND, CPU, GPU), ("EPYC", "CPU", OCLGRIND, CPU, GPU), ("H200", "some gpu", CPU, GPU),
        ("H200", "1", CPU, GPU),
    ]:  # fmt: skip
        machine(*platforms)
        device, reason = choose_device(wish)
        assert device.name == chosen and (wish or "capability") in reason


def test_checkers_and_emulators_are_taken_by_name_alone_and_unknown_devices_are_named_with_the_known(machine) -> None:
    for platform in (OCLGRIND, FPGA, EMULATOR):
        machine(platform)
        name = platform.get_devices()[0].name
        with pytest.raises(DeviceError, match=re.escape(name)):
            choose_device()
        assert choose_device(name)[0].name == choose_device("0")[0].name == name
    machine(OCLGRIND, CPU)
    with pytest.raises(DeviceError, match="'gpu', which fits no device"):
        choose_device("gpu")
    machine(CPU, GPU)
    for wish in ("no such thing", "7"):
        with pytest.raises(DeviceError) as raised:
            choose_device(wish)
        assert all(word in str(raised.value) for word in (wish, "--device", "0: EPYC", "1: H200"))


def test_the_environment_wishes_too_and_the_option_wins(machine, monkeypatch) -> None:
    machine(CPU, GPU)
    monkeypatch.setenv(DEVICE_VARIABLE, "epyc")
    device, reason = choose_device()
    assert device.name == "EPYC" and DEVICE_VARIABLE in reason
    assert choose_device("h200")[0].name == "H200"
    monkeypatch.setenv(DEVICE_VARIABLE, "nothing")
    with pytest.raises(DeviceError, match=DEVICE_VARIABLE):
        choose_device()


def test_no_device_says_how_to_get_one(machine, monkeypatch) -> None:
    machine()
    with pytest.raises(DeviceError, match="pip install"):
        choose_device()

    def none_found() -> list:
        raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

    monkeypatch.setattr(devices.cl, "get_platforms", none_found)
    assert list_devices() == []


def test_devices_report_themselves(rt, machine) -> None:
    device = rt.device
    assert device in list_devices() and device.by_default
    assert device.vector_width >= 1 and device.largest_allocation_bytes > 1 << 20
    assert rt.lanes == 1 or device.kind == "cpu"
    machine(fake_platform("Some CPU runtime", fake_device("pthread", type=0xFFFFFFFF)))
    assert list_devices()[0].kind == "cpu"
