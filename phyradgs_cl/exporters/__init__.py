"""Writes volumes in other programs' formats, with spacing, origin and directions. Call ``export_volume``."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters import writers
from phyradgs_cl.exporters.dicom import DicomLabels, write_dicom
from phyradgs_cl.fields import Deformation, Hounsfield, States
from phyradgs_cl.fields.hounsfield import Box
from phyradgs_cl.io import Volume, read_state, read_volume, refuse_overwriting, write_volume

VOXELS: dict[str, Callable[[Path, Volume, str], None]] = {
    **dict.fromkeys(("nii", "mha", "nrrd"), writers.write_image), "tiff": writers.write_tiff, "npy": writers.write_npy,
}
CLOUDS = {"ply": writers.write_ply, "npz": writers.write_npz}
EXPORTS = (*VOXELS, "dicom", *CLOUDS, "zarr")
OWN = "h5"
"""This package's volume files. Their values stay in 1/mm; a scale of Hounsfield units is stored next to them."""
ScaleOf = Callable[[Volume], Hounsfield | None]
_SUFFIXES: dict[str, tuple[str, ...]] = {
    **{to: (f".{to}",) for to in (*EXPORTS, OWN)},
    **{"nii": (".nii", ".nii.gz"), "tiff": (".tif", ".tiff"), "dicom": (), "zarr": (".ome.zarr", ".zarr")},
}
# Suffixes of formats that are not written: an HDF5 file with such a name would be read as something else.
_NOT_WRITTEN = (".mhd", ".dcm", ".png", ".jpg", ".raw", ".vol", ".bin", ".img", ".mat", ".vtk", ".vti", ".csv", ".json")
_PLAIN = "values in 1/mm"  # a note for files of other programs, which have no field for this unit


def export_volume(
    path: str | Path, to: str, output: str | Path | None = None, mu_water_per_mm: float | None = None,
    labels: DicomLabels | None = None, scale_of: ScaleOf | None = None, doubt: bool = False,
) -> Path:  # fmt: skip
    """Writes a volume file in another format, completely or not at all. Returns the path of the output.

    to: one of ``EXPORTS``: ply and npz write the Gaussians, all others the voxels. ``OWN`` writes a volume file and adds a
    scale of Hounsfield units.
    output: a file, or a folder for dicom and zarr. None writes next to ``path``, error bars under NAME.doubt.
    mu_water_per_mm: water's attenuation; the values are then written in Hounsfield units.
    scale_of: instead of water's attenuation, a function from the volume to its scale, such as ``hu_scale``.
    labels: patient, study and series, for dicom only. doubt: write the error bars σ in 1/mm in place of the values.

    Raises InputError for an unknown format, a damaged volume, one that lacks the Gaussians or error bars to write, a suffix
    of another format, labels without dicom, and Hounsfield units of Gaussians or error bars. Raises OutputError where the
    output cannot be written."""
    named = Path(path).with_name(f"{Path(path).stem}.doubt.h5") if doubt else Path(path)
    if doubt and to in (*CLOUDS, OWN):
        raise InputError("--doubt", f"given with the format {to}", "a format of voxels", "use nii or mha")
    if doubt and (scale_of is not None or mu_water_per_mm is not None):
        raise InputError("--doubt", "given with Hounsfield units", "values in 1/mm", "leave --hu and options of HU out")
    target, scale_of = _checked(named, to, output, mu_water_per_mm, labels, scale_of)
    stored, unit = read_volume(path), _PLAIN
    if doubt:
        if stored.doubt is None:
            raise InputError(str(path), "no error bars", "a volume of 'reconstruct --doubt'", "run it again with --doubt")
        stored, unit = replace(stored, values=stored.doubt), "error bars (68 %) in 1/mm"
    export_stored(stored, to, target, str(path), scale_of, labels, unit)
    return target


def hu_scale(volume: Volume, air: Box | None = None, water: Box | None = None, insert_hu: float = 0.0) -> Hounsfield | None:
    """Returns the scale of Hounsfield units that the volume states, or one fitted to boxes of ``air`` and ``water`` in mm,
    if any is given. insert_hu: the Hounsfield units of the material in ``water``; a value other than 0 fits a scale too."""
    if (stored := volume.scale) is not None and air is None and water is None and insert_hu == 0:
        return replace(stored, fitted=f"{stored.line}, as stored")
    return volume.hounsfield(air, water, insert_hu).scale


def _checked(
    path: Path, to: str, output: str | Path | None, mu_water_per_mm: float | None, labels: DicomLabels | None,
    scale_of: ScaleOf | None,
) -> tuple[Path, ScaleOf | None]:  # fmt: skip
    """Returns the path to write, and the function from the volume to its HU scale, or None. Raises InputError as
    ``export_volume`` does for arguments that do not fit."""
    checks.one_of("--to", to, (*EXPORTS, OWN))
    if mu_water_per_mm is not None and scale_of is not None:
        raise InputError("--mu-water-per-mm", "given with --hu", "one of the two", "leave one out")
    if mu_water_per_mm is not None:
        stated = Hounsfield(mu_water_per_mm)
        scale_of = lambda _: stated  # noqa: E731
    if to == OWN and scale_of is None:
        raise InputError("--hu", f"not given for {output}", "another format, or a scale to store", "add --hu")
    suffixes = _SUFFIXES[to]  # programs recognise the format by the suffix; the folder of DICOM has none
    target = Path(output or (path.with_suffix(suffixes[0]) if suffixes else path.with_name(f"{path.stem}_dicom")))
    if suffixes and not target.name.lower().endswith(suffixes):
        raise InputError(f"output of --to {to}", str(target), f"a name that ends in {' or '.join(suffixes)}")
    refuse_overwriting("output", target, path)
    if to in CLOUDS and scale_of is not None:
        option = "--hu" if mu_water_per_mm is None else "--mu-water-per-mm"
        raise InputError(option, f"given with --to {to}", "a format of voxels", "leave it out: Gaussians stay in 1/mm")
    if to != "dicom" and labels is not None and labels.given:
        raise InputError(f"--{next(iter(labels.given))}", f"given with --to {to}", "--to dicom", "leave it out")
    return target, scale_of


def _in_unit(volume: Volume, scale: Hounsfield | None, unit: str = _PLAIN) -> tuple[Volume, str]:
    """Returns the volume with float32 values, and a note of their unit: Hounsfield units by ``scale``, if given, else
    ``unit``."""
    values = np.ascontiguousarray(volume.values, np.float32)
    return replace(volume, values=values if scale is None else scale.of(values)), unit if scale is None else scale.note


def state_times_s(moves: Deformation | States, count: int, during_s: tuple[float, float] | None = None) -> list[float]:
    """Returns times (count,) in s: middles of equal parts of ``during_s``, by default the motion's whole time. If ``moves``
    are ``count`` stored states and no ``during_s`` is given, returns their times. Raises InputError for a count outside 1 to
    1000, and for a ``during_s`` that does not end after its begin, or lies entirely outside the motion's time."""
    checks.whole("--states", count, 1, 1000)
    if isinstance(moves, States) and during_s is None and count == len(moves.times_s):
        return moves.times_s.tolist()
    begin_s, end_s = moves.span_s if isinstance(moves, States) else (float(moves.times_s[0]), float(moves.times_s[-1]))
    first_s, last_s = during_s or (begin_s, end_s)
    if during_s is not None and not first_s < last_s:
        raise InputError("--during", f"{first_s:g},{last_s:g}", "a start before the stop")
    if begin_s < end_s and (last_s <= begin_s or first_s >= end_s):
        raise InputError("--during", f"{first_s:g},{last_s:g} s", f"a part of the motion's {begin_s:g} to {end_s:g} s")
    return (first_s + (np.arange(count) + 0.5) / count * (last_s - first_s)).tolist()


def export_states(
    path: str | Path, deformation: Deformation | None, times_s: Sequence[float], to: str,
    output: str | Path | None = None, mu_water_per_mm: float | None = None, labels: DicomLabels | None = None,
    scale_of: ScaleOf | None = None,
) -> list[Path]:  # fmt: skip
    """Writes the object of a volume file at the times ``times_s`` in s, and returns the paths. deformation: how the object
    moves; None if the file has the object at several times. NIfTI has all times in one file of four dimensions. Other
    formats have a file or folder per time: NAME_01.SUFFIX and so on. See ``export_volume`` for other arguments and errors.
    Raises InputError also for a format of Gaussians, and for a deformation that moves nothing in the volume's grid."""
    if to in (*CLOUDS, OWN):
        remedy = f"use {', '.join(VOXELS)}, zarr or dicom"
        raise InputError("--states", f"given with --to {to}", "a format of voxels", remedy)
    target, scale_of = _checked(Path(path), to, output, mu_water_per_mm, labels, scale_of)
    volume = read_volume(path)
    grid, scale = volume.required_grid, None if scale_of is None else scale_of(volume)
    if deformation is not None:
        moves = any(deformation.on_grid_mm(grid, unit).any() for unit in np.eye(deformation.rank))
        if deformation.control_mm.any() and not moves:
            found = "a deformation that moves nothing in the volume's grid"
            raise InputError("--object-motion", found, "one of this volume", "check origin and unit of its control points")
        volume = volume.moved_by(deformation, str(path))
    states = [replace(volume, values=volume.at(time_s)) for time_s in times_s]
    if to == "nii":
        stack, notes = zip(*(_in_unit(state, scale) for state in states), strict=True)
        writers.write_image(target, stack[0], notes[0], times_s, stack)
        return [target]
    suffix = next((s for s in _SUFFIXES[to] if target.name.lower().endswith(s)), "")
    stem, digits = target.name[: len(target.name) - len(suffix)], max(2, len(str(len(states))))
    targets = [target.with_name(f"{stem}_{k:0{digits}d}{target.name[len(stem) :]}") for k in range(1, len(states) + 1)]
    for state, one in zip(states, targets, strict=True):
        export_stored(state, to, one, str(path), lambda _: scale, labels)
    return targets


def export_stored(
    volume: Volume, to: str, target: Path, subject: str, scale_of: ScaleOf | None = None,
    labels: DicomLabels | None = None, unit: str = _PLAIN,
) -> None:  # fmt: skip
    """Writes a volume as ``export_volume`` does. subject: what messages call the volume, for ``OWN`` the path of its file.
    unit: a note for values without a scale of Hounsfield units."""
    if to in CLOUDS:
        CLOUDS[to](target, writers.gaussians_of(volume, subject))
        return
    if volume.grid is None:
        raise InputError(subject, "values without voxel sizes", "a volume with its grid", "see 'phyradgs info'")
    scale = None if scale_of is None else scale_of(volume)
    if to == OWN:
        facts = volume.provenance if scale is None else {**volume.provenance, **scale.facts()}
        parts = volume.gaussians, volume.metrics, read_state(subject), volume.deformation, volume.states, volume.doubt
        write_volume(target, volume.values, volume.grid, facts, *parts)
        return
    if to == "zarr":
        writers.write_zarr(target, volume, scale, unit)
        return
    volume, note = _in_unit(volume, scale, unit)
    if to == "dicom":
        write_dicom(target, volume, note, labels or DicomLabels())
    else:
        VOXELS[to](target, volume, note)


def foreign_suffix(output: str | Path) -> str | None:
    """Returns the path's suffix if it belongs to another program's format, so that no HDF5 may have it; else None."""
    suffixes = *(suffix for to in EXPORTS for suffix in _SUFFIXES[to]), *_NOT_WRITTEN
    return next((suffix for suffix in suffixes if Path(output).name.lower().endswith(suffix)), None)


def format_of(output: str | Path | None, subject: str = "--to") -> str:
    """Returns the format, in ``EXPORTS`` or ``OWN``, that a suffix names. Raises InputError for other suffixes and None."""
    for to in (*EXPORTS, OWN):
        if output is not None and _SUFFIXES[to] and Path(output).name.lower().endswith(_SUFFIXES[to]):
            return to
    suffixes = ", ".join(suffix for to in EXPORTS for suffix in _SUFFIXES[to])
    found = "neither a format nor an output" if output is None else f"output {output}"
    remedy = "use such a suffix, or give --to dicom" if subject == "--to" else "or .h5, which holds everything"
    raise InputError(subject, found, f"a suffix of {suffixes}", remedy)
