"""Limits of device memory: how they are written, that they hold, and what is said where they do not suffice."""

import gc
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from phyradgs_cl.errors import InputError, OutOfMemoryError
from phyradgs_cl.runtime import MEMORY_VARIABLE, MemoryShortage, Room, Runtime, attempts, bytes_of
from phyradgs_cl.runtime.memory import MemoryLedger


def test_sizes_and_the_names_of_pythons_arguments() -> None:
    sizes = {"2GiB": 2 << 30, "2gb": 2 * 10**9, "1.5 G": 3 << 29, "512M": 512 << 20, " 64 kib ": 65_536, "100B": 100}
    for text, nbytes in {**sizes, "4096": 4096, 4096: 4096}.items():
        assert bytes_of(text, "--memory") == nbytes, text
    for text in ("", "GiB", "-1G", "0", "0.0MiB", "2 GiBs", "two", "1e3", "nan", "1" * 40, True, "2,5G"):
        with pytest.raises(InputError, match="--memory.*2GiB"):
            bytes_of(text, "--memory")

    for argument, value in (("memory", "abc"), ("memory", -1), ("device", "no such device")):
        with pytest.raises(InputError) as caught:
            Runtime(**{argument: value})
        assert caught.value.subject == argument and "--" not in str(caught.value)


def test_the_limit_holds_for_all_buffers_together_and_the_environment_limits_what_no_option_does(monkeypatch) -> None:
    monkeypatch.setenv(MEMORY_VARIABLE, "1MiB")
    assert Runtime().ledger.limit_bytes == 1 << 20
    rt = Runtime(memory="64KiB")
    first = rt.empty(10_000)
    with pytest.raises(MemoryShortage, match=r"what is left of.*--memory or PHYRADGS_MEMORY"):
        rt.empty(10_000)
    assert rt.ledger.held_bytes == 40_000
    del first
    gc.collect()
    assert rt.empty(16_384).nbytes == rt.ledger.held_bytes == 65_536
    with pytest.raises(MemoryShortage):
        rt.empty(16_385)
    assert rt.peak_bytes == 65_536


def test_without_a_limit_it_is_what_the_device_reports_or_less_of_a_gpu_that_does_not_say_what_is_free(rt) -> None:
    """The screen and other programs hold memory too. AMD's extension says how much is free."""
    room = rt.room()
    assert 0 < room.free_bytes < rt.device.memory_bytes
    assert room.largest_bytes <= rt.device.largest_allocation_bytes
    assert room.holds(room.free_bytes) == (room.free_bytes <= room.largest_bytes)
    assert not room.holds(room.free_bytes, 1)
    assert rt.download(rt.empty((0, 7))).shape == (0, 7)
    assert rt.upload(np.zeros((3, 0), np.float32)).nbytes == 0
    gpu = replace(rt.device, kind="gpu", memory_bytes=1000, largest_allocation_bytes=100)
    assert MemoryLedger(gpu, None).room(100) == Room(600, 100)
    assert MemoryLedger(gpu, 2000).room(100) == Room(1800, 100)  # asked for: an APU may report 256 MB
    assert MemoryLedger(replace(gpu, kind="cpu"), None).room(100) == Room(900, 100)
    amd = SimpleNamespace(extensions="cl_amd_device_attribute_query", global_free_memory_amd=[2, 1])
    ledger = MemoryLedger(replace(gpu, memory_bytes=4096, handle=amd), None)
    assert (ledger.limit_bytes, ledger.room(4096).free_bytes) == (2048, int(0.9 * 2048))


def test_a_shortage_is_met_once(caplog) -> None:
    asked: list[float] = []
    for attempt in attempts("work"):
        with attempt as share:
            asked.append(share)
            if share == 1:
                raise MemoryShortage("memory", "much", "less")
    assert asked == [1.0, 0.25] and "work: memory: found much" in caplog.text
    assert not any(isinstance(argument, Exception) for record in caplog.records for argument in record.args)
    with pytest.raises(OutOfMemoryError, match=r"found 0\.25"):
        for attempt in attempts("work"):
            with attempt as share:
                raise MemoryShortage("memory", f"{share}", "less")


def test_traffic_is_what_crosses_the_bus() -> None:
    rt = Runtime()
    x = rt.upload(np.arange(6, dtype=np.float32))
    rt.write(x, np.zeros(6, np.float32))
    y = rt.zeros(6)
    rt.copy(x, y)
    assert (rt.traffic.bytes_up, rt.traffic.bytes_down, rt.traffic.blocking) == (48, 0, 2)
    rt.download(y)
    rt.read_item(y, 2)
    rt.finish()
    assert (rt.traffic.bytes_up, rt.traffic.bytes_down, rt.traffic.blocking) == (48, 28, 5)
