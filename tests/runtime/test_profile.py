"""Where device time goes: what is counted, and the table that says so."""

import numpy as np

from phyradgs_cl.runtime import KernelUse, Runtime, profile_text


def test_launches_time_and_bytes_are_counted_by_kernel_and_long_runs_do_not_keep_every_event(monkeypatch) -> None:
    profiled = Runtime(profile=True)
    source = profiled.upload(np.ones(1000, np.float32))
    target = profiled.zeros(1000)
    profiled.kernel_uses()
    for _ in range(3):
        profiled.copy(source, target)
    profiled.fill(target, 2.0)
    uses = profiled.kernel_uses()
    assert (uses["copy"].launches, uses["copy"].bytes) == (3, 3 * 2 * 4000)
    assert (uses["fill"].launches, uses["fill"].bytes) == (1, 4000)
    assert all(use.seconds > 0 for use in uses.values())
    assert list(uses) == sorted(uses, key=lambda name: -uses[name].seconds)
    assert profiled.kernel_uses() == {}
    rates = profiled.best_rates()
    assert 1e8 < rates.copy_bytes_per_s < 1e14
    assert 1e8 < rates.flops_per_s < 1e16
    rt = Runtime()
    rt.zeros(10)
    assert rt.kernel_uses() == {}
    monkeypatch.setattr("phyradgs_cl.runtime.profile._FOLD_AT", 4)
    array = profiled.zeros(10)
    profiled.kernel_uses()
    for _ in range(11):
        profiled.fill(array, 1.0)
        assert len(profiled._profile._events) < 4
    assert profiled.kernel_uses()["fill"].launches == 11


def test_the_table_says_shares_and_rates() -> None:
    uses = {"draw": KernelUse(4, 2.0, 8_000_000_000), "add": KernelUse(1, 0.5, 1_000_000_000)}
    draw, add, last = profile_text(uses, 5.0).splitlines()[1:]
    assert draw.split() == ["draw", "4", "2.000", "80.0%", "500.000", "4.0"]
    assert add.split() == ["add", "1", "0.500", "20.0%", "500.000", "2.0"]
    assert last == "kernels 2.50 s of 5.00 s (50%)"
