"""Reads the options of a run from a configuration file and the command line, and makes a checked plan of them."""

import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from phyradgs_cl import checks
from phyradgs_cl import reconstructors as methods
from phyradgs_cl.errors import InputError, PhyradgsError
from phyradgs_cl.importers import load_volume
from phyradgs_cl.io import read_deformation, sha256_of
from phyradgs_cl.io.attenuation import attenuation_of, words_of_hu
from phyradgs_cl.io.tables import read_toml
from phyradgs_cl.parallel import Communicator
from phyradgs_cl.removed import refuse_removed
from phyradgs_cl.runtime import Runtime, bytes_of
from phyradgs_cl.text import flag_of

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@dataclass(frozen=True)
class Settings:
    """A run's options ``values`` by name, not yet checked. origins: where each was given, for messages. device: an index,
    cpu, gpu or part of a name. memory: limit of device memory in bytes. None for either: as ``Runtime`` chooses."""

    values: Mapping[str, Any]
    origins: Mapping[str, str]
    config: Path | None = None
    device: str | None = None
    memory: int | None = None

    def plan(
        self, initial: Path | None = None, object_motion: Path | None = None, mu_water_per_mm: float | None = None
    ) -> methods.RunPlan:
        """Returns the checked plan of a run. Raises InputError for options that are unknown, wrong or out of range.

        initial: the file of a volume to start from. object_motion: the file of the object's deformation. mu_water_per_mm:
        water's attenuation, which converts an ``initial`` volume in Hounsfield units."""
        if mu_water_per_mm is not None and initial is None:
            raise InputError("--mu-water-per-mm", "given without --initial", "a first volume in Hounsfield units")
        values = dict(self.values)
        method, preset = (self._word(values, name) for name in ("method", "preset"))
        run = {
            "seed": values.pop("seed", 0), "initial": None if initial is None else _initial_volume(initial, mu_water_per_mm),
            "object_motion": None if object_motion is None else _object_motion(object_motion),
        }  # fmt: skip
        # A name that both a method and preprocessing have means preprocessing on the command line, as --help says.
        flags = [f.name for f in fields(methods.Preprocessing) if self.origins.get(f.name) == flag_of(f.name)]
        method = method or methods.DEFAULT_METHOD
        refuse_removed(f"--motion {values.get('motion')}", self.origins.get("motion", ""))
        with self.naming_origins(method):
            return methods.plan_run(method, values, preset=preset, of_preprocessing=flags, **run)

    def preprocessing(self, defaults: Mapping[str, object]) -> methods.Preprocessing:
        """Returns checked options of preprocessing alone. ``defaults`` stand for options that were not given."""
        with self.naming_origins():
            return methods.preprocessing_of({**defaults, **self.values})

    def runtime(self, *, profile: bool = False, ranks: Communicator | None = None) -> Runtime:
        with self.naming_origins():
            return Runtime(self.device, profile=profile, memory=self.memory, ranks=ranks)

    @contextmanager
    def naming_origins(self, method: str = "") -> Iterator[None]:
        """Makes an error raised in the body name where the wrong option was given: a key in the file, or a --set."""
        try:
            yield
        except PhyradgsError as error:
            subject = _origin_of(error.subject, self.origins)
            if subject is None:
                raise
            found = error.found
            if found == "no such option" and method:
                found += f" of --method {method}"
            raise type(error)(subject, found, error.expected, error.remedy) from error

    def _word(self, values: dict[str, Any], name: str) -> str | None:
        value = values.pop(name, None)
        if value is not None and not isinstance(value, str):
            raise InputError(self.origins.get(name, flag_of(name)), checks.short_repr(value), "a word in quotation marks")
        return value


def read_settings(
    config: Path | None, given: Mapping[str, object], assignments: Sequence[str] = ()
) -> Settings:
    """Returns the settings of a file ``config``. ``assignments`` NAME=VALUE override it, then ``given`` options if not None.

    Raises InputError for a wrong file, assignment, device or memory."""
    values: dict[str, Any] = {} if config is None else read_toml(config, f"--config {config}")
    origins = {key: f"config {config}: {key}" for key in values}
    for text in assignments:
        merge(values, assignment(text))
        origins[text.split("=")[0].split(".")[0].strip()] = f"--set {text}"
    for key, value in given.items():
        if value is not None:
            values[key] = value
            origins[key] = flag_of(key)
    device, memory = values.pop("device", None), values.pop("memory", None)
    if isinstance(device, int) and not isinstance(device, bool) and 0 <= device < 1_000_000:
        device = str(device)  # the index of a device may be a number in TOML
    device = device_wish(device, origins.get("device", "--device"))
    memory = None if memory is None else bytes_of(memory, origins.get("memory", "--memory"))
    return Settings(values, origins, config, device, memory)


def runtime_for(device: str | None, memory: str | None = None) -> Runtime:
    """Returns the Runtime that a command's --device and --memory ask for. Raises errors that name these options."""
    return read_settings(None, {"device": device, "memory": memory}).runtime()


def _initial_volume(path: Path, mu_water_per_mm: float | None) -> methods.InitialVolume:
    volume = attenuation_of(str(path), load_volume(path, mu_water_per_mm))
    if volume.grid is None:
        raise InputError("--initial", f"{path}, values without voxel sizes", "a volume with its grid in mm")
    facts = {"initial": str(path), "initial_sha256": sha256_of(path)}
    if converted := words_of_hu({path: volume}, mu_water_per_mm):
        facts["initial_converted"] = converted.removeprefix(", ")
    return methods.InitialVolume(volume.values, volume.grid, facts)


def _object_motion(path: Path) -> methods.ObjectMotion:
    facts = {"object_motion": str(path), "object_motion_sha256": sha256_of(path)}
    return methods.ObjectMotion(read_deformation(path), facts)


def _origin_of(subject: str, origins: Mapping[str, str]) -> str | None:
    """Returns where the user gave the option that a message's ``subject`` names: a flag or a file entry; None if nowhere."""
    words = re.findall(r"option ([\w-]+)", subject) or re.sub(r"\(.*\)", "", subject).split()[-1:]
    first, *rest = [part for word in words for part in word.lstrip("-").split(".")] or [""]
    origin = origins.get(first.replace("-", "_"))
    return origin if origin is None or origin.startswith("--") else ".".join([origin, *rest])


def assignment(text: str) -> dict[str, Any]:
    """Parses NAME=VALUE. VALUE: TOML, or text without quotation marks as in prior=dct. Raises InputError for other text."""
    name, sign, value = text.partition("=")
    if not (sign and name.strip()):
        raise InputError("--set", repr(text), "NAME=VALUE", "write for example tv_weight=0.002")
    for line in (f"{name} = {value}", f"{name} = {json.dumps(value.strip())}"):
        with suppress(ValueError, RecursionError):
            return tomllib.loads(line)
    raise InputError("--set", repr(text), "NAME=VALUE with a name such as tv_weight or rates.position")


def merge(settings: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """Overrides ``settings`` by ``changes``, in place. Of nested tables only the entries in ``changes`` are replaced."""
    for key, value in changes.items():
        if isinstance(value, Mapping) and isinstance(settings.get(key), dict):
            merge(settings[key], value)
        else:
            settings[key] = value


def device_wish(value: object, subject: str = "--device") -> str | None:
    """Returns the text that names a device, or None for the best one. Raises InputError about ``subject`` for anything
    else, and for empty text: it would match every device's name."""
    if value is None:
        return None
    if not isinstance(value, str) or not value.strip():
        remedy = "see 'phyradgs devices', or leave it out for the best device"
        raise InputError(subject, checks.short_repr(value), "an index, cpu, gpu or part of a name", remedy)
    return value
