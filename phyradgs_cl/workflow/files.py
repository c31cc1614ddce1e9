"""Loads scans, volumes and true volumes, by what their file holds, and summarises files."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from phyradgs_cl import importers
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.motion import motion_in_words
from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters import foreign_suffix
from phyradgs_cl.fields import MovingTruth
from phyradgs_cl.io import check_writable, deformation_summary, holds_deformation, scan_summary
from phyradgs_cl.io.attenuation import FROM_HU, VALUES
from phyradgs_cl.io.hdf5 import open_hdf5
from phyradgs_cl.io.output import refuse_overwriting
from phyradgs_cl.io.volume import Volume, file_kind, volume_summary
from phyradgs_cl.prepare.light import read_corrected

_KINDS = {
    "scan": "a scan",
    "volume": "a volume of phyradgs-cl",
    "plain-volume": "a bare volume (dataset /volume)",
    "deformation": "how an object moves (/entry/deformation)",
}
_OF_MOTION = ("fields", "control_points", "displacements_below_mm", "smallest_determinant")  # shown of a deformation


def load_scan(path: str | Path, flats: str = "auto", rows: tuple[int, int] | None = None) -> Scan:
    """Reads a scan file as line integrals, see ``read_corrected``. rows: detector rows [first, stop); None reads all. Raises
    InputError for a file that is no scan or is damaged."""
    with expecting(path, "scan"):
        return read_corrected(path, flats, rows)


@contextmanager
def expecting(path: str | Path, *kinds: str) -> Iterator[None]:
    """Improves the message of an InputError about the file ``path``: the message says what the file holds, if that is none
    of ``kinds``. For another program's scan it names the command that imports it."""
    try:
        yield
    except InputError as error:
        found = None
        with suppress(InputError):
            found = file_kind(path)
        if found is not None and found not in kinds:
            expected = " or ".join(_KINDS[kind] for kind in kinds)
            remedy = "see 'phyradgs info' for what a file holds"
            raise InputError(str(path), _KINDS[found], expected, remedy) from error
        if "scan" in kinds and _is_foreign_scan(Path(path)):
            remedy = f"a scan of another program is read by 'phyradgs import {path} -o scan.h5'"
            raise InputError(error.subject, error.found, error.expected, remedy) from error
        raise


def _is_foreign_scan(path: Path) -> bool:
    """Returns whether ``import`` reads ``path``. An NXtomo file whose frames state a quantity is this package's own."""
    try:
        if importers.recognise(path) != "nxtomo":
            return True
        with open_hdf5(path) as source:
            data = [source.find(f"{entry}/instrument/detector/data") for entry in source.groups()]
            return any(frames is not None and "quantity" not in frames.attrs for frames in data)
    except (InputError, OSError):
        return False


def check_output(output: Path, *inputs: Path | None, remedy: str = "write scan.h5") -> None:
    """Raises InputError for an HDF5 output that is also an input, or has another format's suffix, which would mislead
    other programs. Raises OutputError if it cannot be written."""
    refuse_overwriting("-o", output, *inputs)
    if (ending := foreign_suffix(output)) is not None:
        raise InputError("-o", f"the suffix {ending} of another format", "an HDF5 file, as NAME.h5", remedy)
    check_writable(output)


def check_picture(option: str, picture: Path, *others: Path | None, suffixes: Sequence[str] = (".png",)) -> None:
    """Raises InputError for a picture that is one of ``others`` or has a wrong suffix, OutputError if it is not writable."""
    refuse_overwriting(option, picture, *others)
    if picture.suffix.lower() not in suffixes:
        raise InputError(option, str(picture), f"a file name that ends in {suffixes[0]}")
    check_writable(picture)


def load_result(path: Path, mu_water_per_mm: float | None = None) -> Volume:
    """Reads a volume in 1/mm. mu_water_per_mm: water's attenuation, for a file in Hounsfield units that does not state it.
    Raises InputError as ``importers.load_volume`` does."""
    with expecting(path, "volume", "plain-volume"):
        return importers.load_volume(path, mu_water_per_mm)


def load_reference(path: Path, mu_water_per_mm: float | None = None) -> tuple[Volume, MovingTruth | None]:
    """Reads a true volume to compare with, and its states at several times if a scan file has them, else None. The file is
    a scan or a volume. mu_water_per_mm: as in ``load_result``. Raises InputError for a scan without a true volume."""
    if importers.foreign_volume(path) is None and file_kind(path) == "scan":
        scan = load_scan(path)
        if scan.reference is None:
            raise InputError(f"{path}:/entry/phyradgs/reference/volume", "no reference", "a scan with a known truth")
        return Volume(scan.reference, scan.grid, is_stated=True), scan.moving_truth
    return load_result(path, mu_water_per_mm), None


def summary(path: Path) -> dict[str, object]:
    if (form := importers.foreign_volume(path)) is not None:
        if states := [(time_s, _voxel_facts(volume)) for time_s, volume in importers.load_states(path)]:
            (first_s, *_), every = zip(*states, strict=True)
            times = {"states": len(states), "first_s": first_s, "last_s": states[-1][0]}
            extremes = {"minimum": min(f["minimum"] for f in every), "maximum": max(f["maximum"] for f in every)}
            return {"kind": f"volumes of an object that moves ({form})", **times, **every[0], **extremes}
        return {"kind": f"volume ({form})", **_voxel_facts(importers.load_volume(path))}
    with expecting(path, "scan", "volume", "plain-volume", "deformation"):
        kind = file_kind(path)
        if kind == "scan":
            return {"kind": "scan", **scan_summary(path)}
        if kind == "deformation":
            return {"kind": "deformation", **deformation_summary(path)}
    if kind == "volume":
        facts = volume_summary(path)
        provenance = dict(facts.pop("provenance", None) or {})
        provenance.pop("record", None)
        stated = provenance.pop("options", None)
        options: Mapping[str, Any] = stated if isinstance(stated, Mapping) else {}
        motion = motion_in_words(options["motion"]) if isinstance(options.get("motion"), Mapping) else None
        of_run = {"motion": motion, "iterations_asked": options.get("iterations")}
        moves = deformation_summary(path) if holds_deformation(path) else {}
        of_object = {f"motion_{key}": moves[key] for key in _OF_MOTION if key in moves}
        return {"kind": "volume", **facts, **of_object, **of_run, **provenance}
    return {"kind": "bare volume", **_voxel_facts(importers.load_volume(path))}


def _voxel_facts(volume: Volume) -> dict[str, Any]:
    values, grid = volume.values, volume.grid
    where = {} if grid is None else {"voxel_size_mm": grid.voxel_size_mm, "offset_mm": grid.offset_mm}
    unit = {VALUES: FROM_HU} if volume.provenance.get(VALUES) == FROM_HU else {}
    return {"shape": values.shape, **where, **unit, "minimum": float(values.min()), "maximum": float(values.max())}
