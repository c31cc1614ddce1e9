"""What one rank has to hold and to hand over, and all of it as text."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Load:
    """Of one rank: bytes on its device by what they are for, bytes that it hands over in a step by what they are."""

    device: dict[str, int]
    exchange: dict[str, int]

    @property
    def device_bytes(self) -> int:
        return sum(self.device.values())

    @property
    def exchange_bytes(self) -> int:
        return sum(self.exchange.values())


@dataclass(frozen=True)
class RankPlan:
    """``loads`` by a heading, the number of Gaussians for which they hold; ``facts`` say in words who has what."""

    method: str
    ranks: int
    step: str
    facts: tuple[str, ...]
    loads: dict[str, Load]

    def text(self, limit_bytes: int | None = None) -> str:
        """The shares, then tables of bytes; whether they are within ``limit_bytes`` of a device."""
        lines = [f"{self.method} over {self.ranks} ranks", *(f"  {fact}" for fact in self.facts)]
        for title, rows_of in (
            ("device memory a rank", lambda load: load.device),
            (f"exchanged by a rank in {self.step}", lambda load: load.exchange),
        ):
            lines += [f"{title:<44}" + "".join(f"{heading:>22}" for heading in self.loads)]
            lines += _table([rows_of(load) for load in self.loads.values()])
        if limit_bytes is not None:
            found = [
                "fits" if load.device_bytes <= limit_bytes else "too much" for load in self.loads.values()
            ]
            lines.append(
                f"{f'in {size_text(limit_bytes)} of a device':<44}" + "".join(f"{word:>22}" for word in found)
            )
        return "\n".join(lines)


def _table(loads: list[dict[str, int]]) -> list[str]:
    names = list(loads[0])
    if not names:
        return ["  nothing"]
    lines = [f"  {name:<42}" + "".join(f"{size_text(load[name]):>22}" for load in loads) for name in names]
    return [*lines, f"  {'in all':<42}" + "".join(f"{size_text(sum(load.values())):>22}" for load in loads)]


def size_text(nbytes: int) -> str:
    """A size for people, which lines up in a column: 12.3 MiB, 0.4 KiB."""
    for unit, factor in (("GiB", 2**30), ("MiB", 2**20)):
        if nbytes >= factor:
            return f"{nbytes / factor:.1f} {unit}"
    return f"{nbytes / 1024:.1f} KiB"
