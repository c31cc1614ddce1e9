"""What a run is asked to do: the configuration file, the command line that wins over it, and words into values."""

import json
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError, PhyradgsError
from phyradgs_cl.io.tables import read_toml
from phyradgs_cl.reconstructors import (
    DEFAULT_METHOD,
    InputOptions,
    input_names,
    input_options,
    method_name,
    method_options,
)
from phyradgs_cl.runtime import bytes_of

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

LARGEST_SEED = 2**63


@dataclass(frozen=True)
class RunSettings:
    """A reconstruction as it is asked for; ``changes`` are the method's own options by name, unchecked. ``before``:
    what is done to the frames first. ``origins``: where values that are no named options come from, for errors.
    ``memory``: the device's limit, bytes or text as 2GiB."""

    method: str
    preset: str | None
    seed: int
    device: str | None
    changes: Mapping[str, Any]
    before: InputOptions = InputOptions()
    memory: str | int | None = None
    origins: Mapping[str, str] = field(default_factory=dict)

    @contextmanager
    def naming_origins(self) -> Iterator[None]:
        """Errors about an option, in the body, name the line of the file or the --set that it comes from."""
        try:
            yield
        except PhyradgsError as error:
            subject = _origin_of(error.subject, self.origins)
            if subject is None:
                raise
            found = error.found
            if found == "no such option" and self.method:
                found += f" of --method {self.method}"
            raise type(error)(subject, found, error.expected, error.remedy) from error


def run_settings(
    config: Path | None, given: Mapping[str, object], assignments: Sequence[str] = ()
) -> RunSettings:
    """The settings of a configuration file; over them ``assignments`` NAME=VALUE; over both what is given, not None;
    all over the preset. They are checked here, so that an error can say where a wrong value stands."""
    settings, origins = _collected(config, given, assignments)
    chosen = _run_settings(settings, origins)
    with chosen.naming_origins():
        method_options(chosen.method, chosen.preset, chosen.changes, chosen.before.tune)
    return chosen


def input_settings(
    config: Path | None, given: Mapping[str, object], assignments: Sequence[str], usual: Mapping[str, object]
) -> RunSettings:
    """``run_settings`` of what comes before every method, and of no method: ``before``, device and memory. usual: values of
    what nobody gave."""
    settings, origins = _collected(config, given, assignments)
    settings = {**usual, **settings}
    wish, memory = _device_and_memory(settings, origins)
    chosen = RunSettings("", None, 0, wish, {}, memory=memory, origins=origins)
    with chosen.naming_origins():
        return replace(chosen, before=input_options(settings))


def _collected(
    config: Path | None, given: Mapping[str, object], assignments: Sequence[str]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Values by name, and where each comes from."""
    settings = read_config(config)
    origins = {key: f"config {config}: {key}" for key in settings}
    for text in assignments:
        merge(settings, assignment(text))
        origins[text.split("=")[0].split(".")[0].strip()] = f"--set {text}"
    for key, value in given.items():
        if value is not None:
            settings[key] = value
            origins[key] = _flag(key)
    return settings, origins


def _flag(key: str) -> str:
    return f"--{key.replace('_', '-')}"


def _run_settings(settings: dict[str, Any], origins: Mapping[str, str]) -> RunSettings:
    method = _word(settings, "method", origins)
    preset = _word(settings, "preset", origins)
    seed = _seed(settings.pop("seed", 0), origins.get("seed", "--seed"))
    wish, memory = _device_and_memory(settings, origins)
    chosen = RunSettings(
        DEFAULT_METHOD if method is None else method, preset, seed, wish, settings, memory=memory, origins=origins
    )
    with chosen.naming_origins():
        theirs = input_names(chosen.method, preset)
        flags = [f.name for f in fields(InputOptions) if origins.get(f.name) == _flag(f.name)]  # mean what --help says
        before = {name: settings.pop(name) for name in {*theirs, *flags} if name in settings}
        return replace(chosen, method=method_name(chosen.method), before=input_options(before))


def _device_and_memory(settings: dict[str, Any], origins: Mapping[str, str]) -> tuple[str | None, int | None]:
    device = settings.pop("device", None)
    if isinstance(device, int) and not isinstance(device, bool) and 0 <= device < 1_000_000:
        device = str(device)  # in TOML an index is a number
    wish = device_wish(device, origins.get("device", "--device"))
    memory = settings.pop("memory", None)
    return wish, None if memory is None else bytes_of(memory, origins.get("memory", "--memory"))


def _origin_of(subject: str, origins: Mapping[str, str]) -> str | None:
    """Where the option that ``subject`` names stands, with the way into its table; None where nobody gave it."""
    options = re.findall(r"option ([\w-]+)", subject)
    words = options or re.sub(r"\(.*\)", "", subject).split()[-1:]
    first, *rest = [part for word in words for part in word.lstrip("-").split(".")] or [""]
    origin = origins.get(first.replace("-", "_"))
    if origin is None or origin.startswith("--"):
        return origin
    return ".".join([origin, *rest])


def read_config(path: Path | None, option: str = "--config") -> dict[str, Any]:
    """The content of a TOML file, nothing for None. Raises InputError for a file that is missing or not TOML."""
    return {} if path is None else read_toml(path, f"{option} {path}")


def assignment(text: str) -> dict[str, Any]:
    """NAME=VALUE as a line of TOML; a value that is not TOML is a word, so that order=random needs no quotes."""
    name, sign, value = text.partition("=")
    if not (sign and name.strip()):
        raise InputError("--set", repr(text), "NAME=VALUE", "write for example tv_weight=0.002")
    for line in (f"{name} = {value}", f"{name} = {json.dumps(value.strip())}"):
        with suppress(ValueError, RecursionError):
            return tomllib.loads(line)
    raise InputError("--set", repr(text), "NAME=VALUE with a name such as tv_weight or rates.position")


def merge(settings: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """Puts ``changes`` into ``settings``, table into table."""
    for key, value in changes.items():
        if isinstance(value, Mapping) and isinstance(settings.get(key), dict):
            merge(settings[key], value)
        else:
            settings[key] = value


def device_wish(value: object, subject: str = "--device") -> str | None:
    """The device asked for, or None; an empty wish would otherwise pass for none, or for any."""
    if value is None:
        return None
    if not isinstance(value, str) or not value.strip():
        remedy = "see 'phyradgs devices', or leave it out for the best device"
        raise InputError(subject, checks.shown(value), "an index, cpu, gpu or part of a name", remedy)
    return value


def pair_parser(
    option: str, form: str, example: str, largest: float = math.inf
) -> Callable[[str], tuple[float, float]]:
    """Reads two finite numbers with a comma between, ``form``, in size at most ``largest``."""

    def pair(text: str) -> tuple[float, float]:
        try:
            first, second = (float(part) for part in text.split(","))
        except ValueError:
            raise InputError(option, repr(text), f"two numbers {form}", f"write for example {example}") from None
        if not all(math.isfinite(x) and abs(x) <= largest for x in (first, second)):
            raise InputError(option, repr(text), f"two numbers {form}, of at most {largest:g}")
        return first, second

    return pair


def numbers(text: str) -> float | list[float] | str:
    """A number, or several with commas between; a text that is neither as it is, for the error of whoever wants numbers."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        return text
    return found if len(found) > 1 else found[0]


def _word(settings: dict[str, Any], key: str, origins: Mapping[str, str]) -> str | None:
    value = settings.pop(key, None)
    if value is not None and not isinstance(value, str):
        raise InputError(origins.get(key, f"--{key}"), checks.shown(value), "a word in quotation marks")
    return value


def _seed(value: object, subject: str) -> int:
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= LARGEST_SEED:
        raise InputError(subject, checks.shown(value), f"a whole number from 0 to {LARGEST_SEED}")
    return value
