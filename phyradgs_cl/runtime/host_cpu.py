"""The host's processor, as Linux describes it."""

import contextlib
import platform
from pathlib import Path


def cpu_facts(described: Path = Path("/proc/cpuinfo")) -> dict[str, str]:
    """What the system says of its first processor ("model name", "flags", …); nothing where it keeps no such file."""
    facts: dict[str, str] = {}
    with contextlib.suppress(OSError):
        for line in described.read_text().split("\n\n", 1)[0].splitlines():
            name, _, value = line.partition(":")
            facts[name.strip()] = value.strip()
    return facts


def cpu_name(facts: dict[str, str] | None = None) -> str:
    """The processor's name, with family and model where they are known: generations may share a name."""
    facts = cpu_facts() if facts is None else facts
    name = facts.get("model name") or platform.processor() or platform.machine()
    if "cpu family" in facts and "model" in facts:
        return f"{name}, family {facts['cpu family']} model {facts['model']}"
    return name
