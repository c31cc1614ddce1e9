"""Gaussians over ranks: bytes of clouds, footprints, frames and images; bytes of gradients, or of what parts draw."""

from __future__ import annotations

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.cells import TimeCells, layer_numbers
from phyradgs_cl.errors import InputError
from phyradgs_cl.operators.layout import CELL_FLOATS, GUARD, pitch_of, stride_of
from phyradgs_cl.operators.splat import RECORD_FLOATS, SUM_FLOATS
from phyradgs_cl.operators.voxelise import RECORD_FLOATS as VOXEL_RECORD_FLOATS
from phyradgs_cl.parallel import span
from phyradgs_cl.rank_plan.load import Load, RankPlan, size_text
from phyradgs_cl.reconstructors.splat_frames import cells_of_scan, cells_within
from phyradgs_cl.reconstructors.splat_options import SplatOptions

_PARAMETERS = 59  # of a Gaussian: raw, two moments, gradients, statistics, parameters
_SUMMED = 13  # rows of gradients and statistics
_LISTED = 12  # entries of a Gaussian in the lists of tiles and bands, with their slack: from runs
_SEEN_BYTES = 1  # whether a cell sees a Gaussian
_FLAG_BYTES = 4


class SplatPlan:
    """Sizes of a scan under the options of a splatting method, on so many ranks."""

    def __init__(self, scan: Scan, options: SplatOptions, ranks: int) -> None:
        self.scan, self.options, self.ranks = scan, options, ranks
        rows, columns = scan.geometry.detector_shape
        self.lines, self.width = (columns, rows) if scan.shutter.axis == "columns" else (rows, columns)
        self.batch = options.batch_for(scan.frames, ranks)
        self.by_domain = options.split == "domain"
        fewest = ranks if self.by_domain else -(-ranks // self.batch)
        self.parts = options.parts or fewest
        if self.parts < fewest:
            found = f"{self.parts} for {ranks} ranks"
            raise InputError("--parts", found, f"at least {fewest}", "raise it, or take fewer ranks")
        self.tables, merges = cells_of_scan(scan, options)
        self.largest = max(self.tables, key=lambda table: table.count)
        self.layers = max(map(_layers, self.tables)) if merges else 0
        self.image_bytes = 4 * (GUARD + self.lines * pitch_of(self.width))
        self.edge = tuple(min(options.tv_edge, n) for n in scan.grid.shape)

    def plan(self, method: str) -> RankPlan:
        first = self.options.gaussians_for(self.scan.grid)
        most = max(first, self.options.control.max_gaussians) if self.options.control.every else first
        loads = {f"{count} Gaussians": self.load(count) for count in dict.fromkeys((first, most))}
        step = f"a step of {self.batch} frame{'s' if self.batch > 1 else ''}"
        return RankPlan(method, self.ranks, step, self.facts(), loads)

    def facts(self) -> tuple[str, ...]:
        frames, slices = self.scan.frames, self.scan.grid.shape[0]
        host = (
            f"host memory at the start: {size_text(self.host_bytes())} of rank 0, frames and first volume; "
            f"{size_text(self.scan.projections.nbytes)} of the others, frames"
        )
        if self.by_domain:
            return (
                f"domain: {self.parts} parts of the Gaussians by height, {self._parts_of_a_rank()} a rank at most",
                f"frames: on the host of every rank, all {frames}; one at a time on the device",
                f"volume: {slices} slices on the host of rank 0, a slab at a time on every device",
                host,
            )
        if self.parts > 1:
            share = f"{self.parts} parts of the lines of a frame, {self._parts_of_a_rank()} a rank at most"
        else:
            share = f"{self.batch} frames a step, {-(-self.batch // self.ranks)} a rank at most"
        return (
            f"frames: {share}; all {frames} on every device",
            "Gaussians: all on every device",
            f"volume: {slices} slices on the host of rank 0, in bricks on every device",
            host,
        )

    def _parts_of_a_rank(self) -> int:
        team = self.ranks if self.by_domain else max(self.ranks // min(self.batch, self.ranks), 1)
        return -(-self.parts // team)

    def host_bytes(self) -> int:
        """Frames as they are and filtered, and FDK's volume in two units."""
        return 2 * self.scan.projections.nbytes + 8 * int(np.prod(self.scan.grid.shape))

    def load(self, gaussians: int) -> Load:
        return Load(
            {
                "Gaussians with gradients and moments": self._gaussians_bytes(gaussians),
                "footprints in all time cells": self._footprints_bytes(gaussians),
                "frames, masks, weights, time cells": self._frames_bytes(),
                "images and their terms": self._images_bytes(),
                "sub-volume of the total variation": self._crop_bytes(gaussians),
            },
            self._exchange(gaussians),
        )

    def _clouds(self, gaussians: int) -> list[int]:
        """Columns of the clouds on the device of the rank that has most."""
        if not self.by_domain:
            return [stride_of(gaussians)]
        runs = [len(span(gaussians, self.parts, part)) for part in range(self.parts)]
        each = [
            [stride_of(runs[part]) for part in span(self.parts, self.ranks, rank)]
            for rank in range(self.ranks)
        ]
        return max(each, key=sum)

    def _gaussians_bytes(self, gaussians: int) -> int:
        shares_frames = not self.by_domain and (self.ranks > 1 or self.batch > 1 or self.parts > 1)
        columns = _PARAMETERS + (2 if shares_frames else 0)  # statistics of a frame by themselves
        return 4 * columns * sum(self._clouds(gaussians))

    def _footprints_bytes(self, gaussians: int) -> int:
        stride, moving = max(self._clouds(gaussians)), self.largest.end_poses is not None
        cells = self.largest.count
        if self.parts > 1 and not self.by_domain:
            cells = max(
                cells_within(self.largest, span(self.lines, self.parts, part)).count
                for part in range(self.parts)
            )
        return stride * (cells * (4 * (RECORD_FLOATS[moving] + SUM_FLOATS) + _SEEN_BYTES) + 4 * (6 + _LISTED))

    def _frames_bytes(self) -> int:
        mask = self.scan.pixel_mask
        images = (1 if mask is None or mask.ndim == 2 else self.scan.frames) + (
            self.scan.frames if self.options.poisson_weight > 0 else 0
        )
        images += 1 if self.by_domain else self.scan.frames
        tables = sum(_table_bytes(table, self.lines) for table in self.tables)
        return images * self.image_bytes + tables

    def _images_bytes(self) -> int:
        return (1 + 12 + 3 * self.layers) * self.image_bytes

    def _crop_bytes(self, gaussians: int) -> int:
        if self.options.tv_weight == 0:
            return self._crop_voxels_bytes()
        stride = max(self._clouds(gaussians))
        return 4 * stride * (VOXEL_RECORD_FLOATS + 6 + SUM_FLOATS) + 2 * self._crop_voxels_bytes()

    def _crop_voxels_bytes(self) -> int:
        depth, rows, columns = self.edge
        return 4 * (GUARD + depth * rows * pitch_of(columns))

    def _exchange(self, gaussians: int) -> dict[str, int]:
        if self.ranks == 1:
            return {}
        flag = {"asking whether to stop": _FLAG_BYTES}
        if self.by_domain:
            drawn = 8 + 2 * (max(self.layers, 1) * self.image_bytes + 4 * GUARD)
            found = {"what the Gaussians draw": self.batch * drawn}
            if self.options.tv_weight > 0:
                found["sub-volumes"] = self.batch * (8 + 2 * (self._crop_voxels_bytes() + 4 * GUARD))
            return found | flag
        gradients = 8 * _SUMMED * (stride_of(gaussians) + 1)
        found = {"gradients and statistics": gradients}
        if self.parts > 1:
            found["images of a frame's lines"] = self.image_bytes + 4 * GUARD
            found["gradients of a frame's lines"] = gradients
        return found | flag


def _layers(table: TimeCells) -> int:
    return int(layer_numbers(table).max(initial=0)) + 1


def _table_bytes(table: TimeCells, lines: int) -> int:
    """A frame's time cells on the device."""
    moving = table.end_poses is not None
    poses, times = (3, 12 * pitch_of(lines)) if moving else (1, 0)
    return table.count * (4 * CELL_FLOATS + 96 * poses + 8 + times) + 8 * lines + 4 * _layers(table) * lines
