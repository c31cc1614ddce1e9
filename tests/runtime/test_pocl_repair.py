"""The repair of PoCL's unknown processors, on a device record made for the test."""

import ctypes
import os
import struct

import pytest

from phyradgs_cl.runtime import pocl

RECORD_BYTES = 2048


@pytest.fixture
def record():
    """(record, put): a device record full of numbers that are no pointers, and a way to put a name into it."""
    memory = ctypes.create_string_buffer(RECORD_BYTES)
    kept = []

    def put(offset: int, name: bytes) -> None:
        kept.append(ctypes.create_string_buffer(name, 64))
        struct.pack_into("<Q", memory, offset, ctypes.addressof(kept[-1]))

    for offset in range(0, RECORD_BYTES, 8):  # small counts, unmapped and kernel-space addresses
        struct.pack_into("<Q", memory, offset, [0, 16, 0xDEAD0000000, 0xFFFF800000000000][offset // 8 % 4])
    return memory, put


@pytest.fixture(autouse=True)
def on_linux_x86(monkeypatch):
    monkeypatch.setattr(pocl.platform, "system", lambda: "Linux")
    monkeypatch.setattr(pocl, "equivalent_target", lambda: "haswell")


def test_a_known_processor_is_left_alone(record, monkeypatch) -> None:
    """A Zen 3's name says all that it has."""
    memory, put = record
    for target, *names in [
        ("haswell", b"skylake-avx512", b"znver3", b"generic-like", b""),
        ("skylake-avx512", b"sapphirerapids", b"znver30")
    ]:  # fmt: skip
        monkeypatch.setattr(pocl, "equivalent_target", lambda target=target: target)
        for name in names:
            put(400, name)
            before = bytes(memory)
            assert pocl.repair_unknown_target(ctypes.addressof(memory)) is None, name
            assert bytes(memory) == before


def test_an_unknown_processor_gets_the_equivalents_name(record) -> None:
    memory, put = record
    put(72, b"not this one")
    put(400, b"generic")
    before = bytes(memory)
    assert pocl.repair_unknown_target(ctypes.addressof(memory)) == "haswell"
    (pointer,) = struct.unpack_from("<Q", memory, 400)
    assert ctypes.string_at(pointer) == b"haswell"
    after = bytes(memory)
    assert before[:400] + before[408:] == after[:400] + after[408:]  # nothing else is touched
    assert pocl.repair_unknown_target(ctypes.addressof(memory)) is None  # and it is done once


def test_a_name_without_avx512_is_replaced_where_there_is_avx512(record, monkeypatch) -> None:
    """LLVM 14 takes Zen 4 for Zen 3; PoCL links its AVX-512 library all the same, and LLVM aborts the process."""
    monkeypatch.setattr(pocl, "equivalent_target", lambda: "skylake-avx512")
    memory, put = record
    for name in (b"generic", b"znver3", b"alderlake"):
        put(400, name)
        assert pocl.repair_unknown_target(ctypes.addressof(memory)) == "skylake-avx512"
        (pointer,) = struct.unpack_from("<Q", memory, 400)
        assert ctypes.string_at(pointer) == b"skylake-avx512"


def test_nothing_is_tried_elsewhere(record, monkeypatch) -> None:
    memory, put = record
    put(400, b"generic")
    monkeypatch.setattr(pocl.platform, "system", lambda: "Darwin")
    assert pocl.repair_unknown_target(ctypes.addressof(memory)) is None
    monkeypatch.setattr(pocl.platform, "system", lambda: "Linux")
    monkeypatch.setattr(pocl, "equivalent_target", lambda: None)
    assert pocl.repair_unknown_target(ctypes.addressof(memory)) is None


AVX512 = {"avx512f", "avx512dq", "avx512bw", "avx512vl", "avx512cd"}
AVX2 = {"avx", "avx2", "fma", "bmi1", "bmi2"}


def test_the_equivalent_has_no_instruction_that_is_missing(monkeypatch) -> None:
    monkeypatch.undo()  # the real function
    for machine, flags, target in [
        ("x86_64", AVX512 | AVX2, "skylake-avx512"), ("AMD64", AVX2, "haswell"),
        ("x86_64", {"avx"}, "sandybridge"),
        ("x86_64", AVX512 - {"avx512vl"} | AVX2, "haswell"), ("x86_64", set(), "x86-64"),
        ("aarch64", AVX2, None),
    ]:  # fmt: skip
        monkeypatch.setattr(pocl.platform, "machine", lambda machine=machine: machine)
        monkeypatch.setattr(pocl, "_cpu_flags", lambda flags=flags: flags)
        assert pocl.equivalent_target() == target, (machine, flags)


def test_kernels_are_cached_per_processor_unless_told_otherwise(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("POCL_CACHE_DIR", "/somewhere")
    pocl.prepare_environment()
    assert os.environ["POCL_CACHE_DIR"] == "/somewhere"
    monkeypatch.delenv("POCL_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    pocl.prepare_environment()
    folder = tmp_path / "phyradgs-cl" / "pocl-haswell"
    assert os.environ["POCL_CACHE_DIR"] == str(folder) and folder.is_dir()
