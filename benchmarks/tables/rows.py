"""Rows of the tables: a label, and the method with its motion model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from phyradgs_cl.errors import InputError
from phyradgs_cl.neural import NeuralOptions, has_torch
from phyradgs_cl.reconstructors import METHODS, method_options
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.text import suggest_name

_MOST_NEURAL_VOXELS = 128  # per side, on a CPU: beyond it a run takes hours
KINDS = ("table1", "table2", "phantom")
_WITH_COUNTS = ("micro-views", "centres")


@dataclass(frozen=True)
class Row:
    """One row: a method with a motion model.

    strips and sub_intervals matter to ``_WITH_COUNTS``. ``still``: the label of the same method with a static model, which
    reconstructs stop-and-shoot scans. ``changes``: further options, which ``variant`` names."""

    label: str
    method: str
    motion: str = "static"
    strips: int | None = None
    sub_intervals: int | None = None
    still: str = ""
    variant: str = ""
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def run(self) -> str:
        """Returns the key of the computation. Rows of two tables with the same run share its result."""
        counts = f"{self.strips}x{self.sub_intervals}" if self.motion in _WITH_COUNTS else ""
        return " ".join(part for part in (self.method, self.motion, counts, self.variant) if part)

    def static(self) -> "Row":
        """Returns the row of the same method with a static model, for a gantry at rest."""
        return Row(self.still or self.label, self.method, variant=self.variant, changes=self.changes)

    def options(self, gaussians: int, iterations: int) -> Any:
        """Returns the method's options. Splatting methods all get the same first cloud and iterations."""
        changes: dict[str, Any] = {"motion": self.motion, **self.changes}
        if self.motion in _WITH_COUNTS:
            changes |= {"strips": self.strips, "sub_intervals": self.sub_intervals}
        if self.is_splatting:
            changes |= {"gaussians": gaussians, "iterations": iterations}
        return method_options(self.method, None, changes)

    @property
    def is_splatting(self) -> bool:
        """Returns whether the method places Gaussians, and so shares their number and the iterations."""
        return self._has(SplatOptions)

    def lacks(self, voxels: int) -> str:
        """Returns what this machine lacks for the row at so many voxels per side, such as PyTorch or a GPU; otherwise ""."""
        if not self._has(NeuralOptions):
            return ""
        if not has_torch():
            return "needs PyTorch"
        from phyradgs_cl.neural.field import torch_device

        return "needs a GPU" if voxels > _MOST_NEURAL_VOXELS and torch_device("auto").type == "cpu" else ""

    def _has(self, options: type) -> bool:
        return isinstance(next(iter(METHODS[self.method].presets.values())), options)


def _micro_views(label: str, method: str, strips: int, sub_intervals: int, still: str) -> Row:
    return Row(label, method, "micro-views", strips, sub_intervals, still)


_CENTRES = Row("PhyRadGS centres only (as GS-on-the-Move)", "phyradgs", "centres", 8, 5, "PhyRadGS w/o ST")
_ITERATIVE = {name.upper(): name for name in ("sart", "os-sart", "sirt", "cgls", "asd-pocs", "fista-tv")}
_FDK = (Row("FDK", "fdk"), Row("FDK per-row", "fdk", "per-row", still="FDK"))
_NEURAL = (
    Row("NAF", "naf"),
    Row("NAF per-row", "naf", "per-row", still="NAF"),
    Row("SAX-NeRF", "sax-nerf"),
    Row("SAX-NeRF per-row", "sax-nerf", "per-row", still="SAX-NeRF"),
)
_SPLATTING = (
    Row("R2-Gaussian", "r2"),
    _micro_views("R2-Gaussian w/ ST", "r2", 8, 5, "R2-Gaussian"),
    Row("PhyRadGS w/o ST", "phyradgs"),
    _micro_views("PhyRadGS", "phyradgs", 8, 5, "PhyRadGS w/o ST"),
    Row("PhyRadGS exact in time", "phyradgs", "exact", still="PhyRadGS w/o ST"),
    _CENTRES,
)
_FUSED = (
    Row("FISTA with DCT", "fista", changes={"prior": "dct"}),
    Row("FISTA with DCT per-row", "fista", "per-row", still="FISTA with DCT", changes={"prior": "dct"}),
    Row(
        "FISTA with DCT on one grid per-row", "fista", "per-row", still="FISTA with DCT on one grid", variant="one grid",
        changes={"prior": "dct", "subvoxels": 1, "iterations": 30},
    ),
    Row("FISTA with ridge", "fista", variant="ridge"),
    Row("FISTA with ridge per-row", "fista", "per-row", still="FISTA with ridge", variant="ridge"),
)


def _table1() -> tuple[Row, ...]:
    static = tuple(Row(label, method) for label, method in _ITERATIVE.items())
    exact = tuple(
        Row(f"{label} per-row", method, "per-row", still=label) for label, method in _ITERATIVE.items()
    )
    return (*_FDK, *static, *exact, *_NEURAL, *_SPLATTING)


def _table2() -> tuple[Row, ...]:
    counts = [(m, 5) for m in (1, 4, 8, 16)] + [(8, n) for n in (1, 3, 7)]
    return (*(_micro_views(f"M={m} N={n}", "phyradgs", m, n, "PhyRadGS w/o ST") for m, n in counts), _CENTRES)


def rows_of(kind: str) -> tuple[Row, ...]:
    """Returns the rows of a table, in order."""
    if kind not in KINDS:
        raise InputError("benchmark", repr(kind), f"one of {', '.join(KINDS)}")
    return _table2() if kind == "table2" else _table1()


def candidate_rows(kind: str) -> tuple[Row, ...]:
    """Returns every row that a kind may have. Rows that are run only when they are asked for by name are at the end."""
    return (*rows_of(kind), *(() if kind == "table2" else _FUSED))


def choose_rows(kind: str, labels: Sequence[str] | None) -> tuple[Row, ...]:
    """Returns the rows of a kind, or those with the given labels in the table's order. InputError: an unknown label."""
    rows = rows_of(kind)
    if not labels:
        return rows
    candidates = candidate_rows(kind)
    by_name = {row.label.casefold(): row for row in candidates}
    wanted = set()
    for label in labels:
        name = label.strip().casefold()
        if name not in by_name:
            known = [row.label for row in candidates]
            raise InputError("--rows", repr(label), "; ".join(known), suggest_name(label, known, ""))
        wanted.add(name)
    return tuple(row for name, row in by_name.items() if name in wanted)
