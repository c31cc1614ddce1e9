"""Other programs' scans: every damage of tests/importers/hostile.py through the command itself."""

import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

from corpus.case import Case

# format: (good file, its options, table of hostile.py)
FORMS: dict[str, tuple[str, tuple[str, ...], str]] = {
    "r2": ("r2", (), "R2"),
    "phyradgs": ("phyradgs", (), "PHYRADGS"),
    "phyradgs-real": ("real", ("--pixel-size-mm", "3.0,2.5"), "REAL"),
    "naf": ("chest.pickle", (), "NAF"),
    "rtk": ("rtk", (), "RTK"),
    "data-exchange": ("dx.h5", ("--source-to-axis-mm", "500", "--source-to-detector-mm", "800"), "EXCHANGE"),
    "nxtomo": ("nx.h5", (), "NXTOMO"),
    "tiff": ("tiff", (), "TIFF"),
}


def helpers(name: str) -> ModuleType:
    """A module of tests/importers, under the name that its own tests have for it."""
    known = f"{name}_of_importers"
    if known not in sys.modules:
        path = Path(__file__).parents[1] / "importers" / f"{name}.py"
        spec = importlib.util.spec_from_file_location(known, path)
        assert spec is not None and spec.loader is not None
        sys.modules[known] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[known])
    return sys.modules[known]


def write_good(folder: Path) -> None:
    """A good file, or folder, of every format."""
    writers, truth_of = helpers("writers"), helpers("conftest").truth
    geometry = helpers("conftest").GEOMETRY
    centred = replace(geometry, detector_offset_mm=(4.0, 0.0))
    for form, (name, _, _) in FORMS.items():
        placed = centred if form == "phyradgs-real" else geometry
        truth = truth_of(fly=form.startswith("phyradgs"), geometry=placed)
        getattr(writers, f"write_{form.replace('-', '_')}")(folder / name, truth)


def cases() -> Iterator[Case]:
    """Every format, as it is and damaged."""
    hostile = helpers("hostile")
    for form, (name, options, table) in FORMS.items():
        command = ("import", "{file}", "--format", form, *options, "-o", "{out}")
        yield Case(f"import of {form}: nothing wrong", name, lambda path: None, command, refused=False)
        for what, (damage, words) in getattr(hostile, table).items():
            yield Case(f"import of {form}: {what}", name, damage, command, words=words)
