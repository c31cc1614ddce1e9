"""The processor that PoCL builds kernels for, on a device record made for the test, and its name in results files."""

import ctypes
import errno
import os
import platform
import struct

import pytest

from phyradgs_cl.runtime import pocl

RECORD_BYTES = 2048
TRIPLE = b"x86_64-unknown-linux-gnu"


@pytest.fixture
def record():
    """(record, put): a device record full of numbers that are no pointers, and a way to put a text into it."""
    memory = ctypes.create_string_buffer(RECORD_BYTES)
    kept = []

    def put(offset: int, text: bytes) -> None:
        kept.append(ctypes.create_string_buffer(text, 64))
        struct.pack_into("<Q", memory, offset, ctypes.addressof(kept[-1]))

    for offset in range(0, RECORD_BYTES, 8):  # small counts, unmapped and kernel-space addresses
        struct.pack_into("<Q", memory, offset, [0, 16, 0xDEAD0000000, 0xFFFF800000000000][offset // 8 % 4])
    return memory, put


@pytest.fixture(autouse=True)
def on_linux_x86(monkeypatch):
    monkeypatch.setattr(pocl.platform, "system", lambda: "Linux")
    monkeypatch.setattr(pocl, "library_target", lambda: "haswell")


@pytest.mark.parametrize("name", [b"generic", b"znver2", b"rocketlake", b"x86-64-v3", b"a-newer-one"])
def test_any_processor_gets_the_name_of_its_library(record, name) -> None:
    memory, put = record
    put(64, b"generic")  # not next to a triple
    put(392, TRIPLE)
    put(400, name)
    before = bytes(memory)
    assert pocl.use_library_target(ctypes.addressof(memory)) == "haswell"
    (pointer,) = struct.unpack_from("<Q", memory, 400)
    assert ctypes.string_at(pointer) == b"haswell"
    after = bytes(memory)
    assert before[:400] + before[408:] == after[:400] + after[408:]  # nothing else is touched
    assert pocl.use_library_target(ctypes.addressof(memory)) == "haswell"
    assert bytes(memory) == after  # the second time there is nothing to do


def test_nothing_is_changed_where_the_record_is_not_understood(record, monkeypatch) -> None:
    memory, put = record
    put(392, b"aarch64-unknown-linux-gnu")
    put(400, b"generic")
    put(600, TRIPLE)
    put(616, b"generic")
    assert pocl.use_library_target(ctypes.addressof(memory)) is None
    put(608, b"generic")
    before = bytes(memory)
    for system, target in (("Darwin", "haswell"), ("Linux", None)):
        monkeypatch.setattr(pocl.platform, "system", lambda system=system: system)
        monkeypatch.setattr(pocl, "library_target", lambda target=target: target)
        assert pocl.use_library_target(ctypes.addressof(memory)) is None
    assert bytes(memory) == before


AVX = {"sse4_1", "ssse3", "avx", "cx16", "popcnt"}
AVX2 = AVX | {"avx2", "f16c", "fma", "bmi1", "bmi2", "abm", "movbe"}
AVX512 = AVX2 | {"avx512f", "avx512dq", "avx512bw", "avx512vl", "avx512cd"}


def test_the_library_is_chosen_as_pocl_chooses_it(monkeypatch) -> None:
    monkeypatch.undo()  # the real function
    for machine, flags, target in [
        ("x86_64", AVX512, "skylake-avx512"), ("AMD64", AVX2, "haswell"), ("x86_64", AVX, "sandybridge"),
        ("x86_64", AVX512 - {"avx512vl"}, "haswell"), ("x86_64", AVX | {"f16c"}, "ivybridge"),
        ("x86_64", AVX | {"f16c", "fma4", "xop"}, "bdver1"), ("x86_64", {"sse4_1", "cx16"}, "penryn"),
        ("x86_64", {"ssse3", "cx16"}, "core2"), ("x86_64", set(), "athlon64"), ("aarch64", AVX2, None),
    ]:  # fmt: skip
        monkeypatch.setattr(pocl.platform, "machine", lambda machine=machine: machine)
        monkeypatch.setattr(pocl, "_cpu_flags", lambda flags=flags: flags)
        assert pocl.library_target() == target, (machine, flags)


def test_kernels_are_cached_per_processor_unless_told_otherwise(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("POCL_CACHE_DIR", "/somewhere")
    pocl.prepare_environment()
    assert os.environ["POCL_CACHE_DIR"] == "/somewhere"
    monkeypatch.delenv("POCL_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    pocl.prepare_environment()
    folder = tmp_path / "phyradgs-cl" / "pocl-haswell"
    assert os.environ["POCL_CACHE_DIR"] == str(folder) and folder.is_dir()


@pytest.mark.parametrize(("owner", "name", "code", "done"), [
    (pocl.mmap, "mmap", errno.EPERM, "executed"), (os, "posix_fallocate", errno.ENOSPC, "written"),
])
def test_a_cache_that_would_end_the_process_is_replaced(owner, name, code, done, tmp_path, monkeypatch, caplog) -> None:
    """As on a mount with noexec, or a full disk."""
    called = getattr(owner, name)

    def refusing(file: int, *how: int) -> object:
        if os.readlink(f"/proc/self/fd/{file}").startswith(str(tmp_path)):
            raise OSError(code, os.strerror(code))
        return called(file, *how)

    monkeypatch.setattr(owner, name, refusing)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv(pocl.CACHE_VARIABLE, "")
    pocl.prepare_environment()
    assert not os.environ[pocl.CACHE_VARIABLE].startswith(str(tmp_path))
    pocl.warn_of_cache()
    assert f"kernel cache {tmp_path}/phyradgs-cl/pocl-haswell cannot be {done}: kernels are kept in" in caplog.text


def test_a_processor_is_named_with_what_tells_generations_apart(tmp_path) -> None:
    """The first of several; where nothing describes it, the name is Python's."""
    one, other = "cpu family\t: 25\nmodel\t\t: 17\nmodel name\t: AMD EPYC\nflags\t\t: fpu vme\n", "cpu family\t: 99\n"
    (tmp_path / "cpuinfo").write_text(f"processor\t: 0\n{one}\nprocessor\t: 1\n{other}")
    facts = pocl.cpu_facts(tmp_path / "cpuinfo")
    assert facts["flags"].split() == ["fpu", "vme"] and pocl.cpu_name(facts) == "AMD EPYC, family 25 model 17"
    assert pocl.cpu_facts(tmp_path / "no such file") == {}
    assert pocl.cpu_name({}) == (platform.processor() or platform.machine())
    assert pocl.cpu_name({"model name": "Cortex"}) == pocl.cpu_name({"model name": "Cortex", "model": "1"}) == "Cortex"
