"""Applies the chosen preparation steps to a scan, in physical order."""

import logging
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare.bad_pixels import DeadOptions, SparkOptions, mask_dead, mask_sparks
from phyradgs_cl.prepare.hardening import HardeningOptions, correct_hardening
from phyradgs_cl.prepare.light import WAYS, AirOptions, normalise_air
from phyradgs_cl.prepare.metal import MetalOptions, mask_metal
from phyradgs_cl.prepare.phase import PhaseOptions, retrieve
from phyradgs_cl.prepare.rings import RingOptions, remove_rings
from phyradgs_cl.prepare.scatter import ScatterOptions, subtract_scatter
from phyradgs_cl.prepare.step import Facts, MakeModel, Step
from phyradgs_cl.prepare.stripes import StripeOptions, correct_stripes
from phyradgs_cl.text import suggest_name

log = logging.getLogger(__name__)

STEPS: Mapping[str, Step] = {
    "sparks": mask_sparks,
    "dead": mask_dead,
    "scatter": subtract_scatter,
    "air": normalise_air,
    "hardening": correct_hardening,
    "rings": remove_rings,
    "stripes": correct_stripes,
    "metal": mask_metal,
    "phase": retrieve,
}
"""The steps by name. They run in this order, whatever the order in which the user names them."""
DEFAULT_STEPS = "sparks,dead,rings"
STEPS_HELP = f"Corrections of the frames, of {', '.join(STEPS)} (docs: prepare.md)."
PREPARED_KEY = "prepared"
"""The key under which a scan's provenance lists the steps that were applied to it."""
# Steps to run only once, because a second run would subtract from what the first one left. A step whose entry in the
# provenance has a "result" corrected nothing, and may run again.
_ONCE = ("scatter", "hardening", "phase")


@dataclass(frozen=True)
class PrepareOptions:
    """The chosen steps and their options. flats: how flats are used when a file is read, one of ``light.WAYS``. steps: names
    of ``STEPS``, separated by commas. Each other field has the options of the step of its name. Raises InputError for
    unknown steps, and for options of steps that are not named."""

    flats: str = checks.option("auto", words=WAYS)
    steps: str = checks.option("", STEPS_HELP, "none", metavar="NAME,...")
    sparks: SparkOptions = SparkOptions()
    dead: DeadOptions = DeadOptions()
    scatter: ScatterOptions = ScatterOptions()
    air: AirOptions = AirOptions()
    hardening: HardeningOptions = HardeningOptions()
    rings: RingOptions = RingOptions()
    stripes: StripeOptions = StripeOptions()
    metal: MetalOptions = MetalOptions()
    phase: PhaseOptions = PhaseOptions()

    def __post_init__(self) -> None:
        checks.fields_within("", self)
        for name in self.steps.split(",") if self.steps.strip() else ():
            if name.strip() not in STEPS:
                remedy = suggest_name(name.strip(), STEPS, "leave it out")
                raise InputError("--steps", checks.short_repr(name.strip()), f"some of {', '.join(STEPS)}", remedy)
        for name in STEPS:
            if name not in self.chosen and getattr(self, name) != type(getattr(self, name))():
                found = f"options of a step that is not among --steps {self.steps or '(none)'}"
                raise InputError(f"option {name}", found, f"{name} among the steps", "add it, or leave the options out")
        if "phase" in self.chosen:
            self.phase.stated()

    @property
    def chosen(self) -> list[str]:
        """The names of the steps to apply, in the order of ``STEPS``."""
        names = {name.strip() for name in self.steps.split(",")}
        return [name for name in STEPS if name in names]

    def step_facts(self) -> dict[str, object]:
        """Returns what the provenance records: ``flats`` and ``steps`` if not the default, and each step's options."""
        flats = {} if self.flats == "auto" else {"flats": self.flats}
        steps = {"steps": ",".join(self.chosen)} if self.chosen else {}
        return {**flats, **steps, **{name: asdict(getattr(self, name)) for name in self.chosen}}


STEP_FIELDS = frozenset(f.name for f in fields(PrepareOptions))


def prepare(scan: Scan, options: PrepareOptions, make_model: MakeModel) -> Scan:
    """Returns the scan after the chosen steps. Its provenance lists them with their options and numbers."""
    for _, after, _ in one_by_one(scan, options, make_model):
        scan = after
    return scan


def one_by_one(
    scan: Scan, options: PrepareOptions, make_model: MakeModel
) -> Iterator[tuple[str, Scan, Facts]]:
    """Applies the chosen steps as ``prepare`` does. Yields for each step its name, the scan after it, and its numbers."""
    if options.flats not in ("auto", scan.provenance.get("flats")):
        expected = "counts and their flats, read from a file: load_scan(path, flats=...)"
        raise InputError("option flats", "a scan of line integrals", expected, "leave it out")
    for name in options.chosen:
        step_options = getattr(options, name)
        earlier: Any = scan.provenance.get(PREPARED_KEY) or []
        if name in _ONCE and any(entry["step"] == name and "result" not in entry for entry in earlier):
            remedy = "leave it out, or start from the scan before that step"
            raise InputError("--steps", f"{name}, which this scan has had", "a step to be done only once", remedy)
        scan, numbers = STEPS[name](scan, step_options, make_model)
        entry = {"step": name, **numbers, "options": asdict(step_options)}
        scan = replace(scan, provenance={**scan.provenance, PREPARED_KEY: [*earlier, entry]})
        log.info("%s: %s", name, numbers)
        yield name, scan, numbers
