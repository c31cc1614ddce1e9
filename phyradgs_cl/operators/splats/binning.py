"""Lists of splats per tile, by a stable counting sort on the device."""

from __future__ import annotations

import numpy as np

from phyradgs_cl.runtime import DeviceArray, MemoryShortage, Runtime

_CHUNK = 512
_SLACK = 1.25
_MOST_ENTRIES = 2**31 - 1  # indices of entries are ints


class TileLists:
    """Builds, for tiles of a 2D or 3D domain, the list of splats whose extent touches each tile.

    ``tile`` is a tile's size and ``tiles`` their number, along x, y, z. Lists keep the order of the splats,
    so everything summed over them repeats bit for bit.
    """

    def __init__(self, rt: Runtime, tile: tuple[int, int, int], tiles: tuple[int, int, int]) -> None:
        self.rt = rt
        self.total = int(np.prod(tiles))
        self.tile = np.array([*tile, 0], np.int32)
        self.tiles = np.array([*tiles, 0], np.int32)
        self.starts = rt.zeros(self.total + 1, np.int32)
        self.entries = rt.empty(1, np.int32)
        self._counts: DeviceArray = rt.empty(1, np.int32)
        self._count = rt.kernel("binning", "bin_count")
        self._within = rt.kernel("binning", "bin_within")
        self._starts = rt.kernel("binning", "bin_starts")
        self._fill = rt.kernel("binning", "bin_fill")

    def build(self, extents: DeviceArray, count: int, stride: int) -> None:
        """Fills ``starts`` (tiles + 1,) and ``entries`` from extents (6, stride).

        Raises MemoryShortage for 2^31 entries or more, which smaller bricks of a volume may not have.
        """
        rt = self.rt
        chunks = chunks_of(count)
        if self._counts.size < self.total * chunks:
            self._counts = rt.empty(1, np.int32)  # the old goes before the new comes
            self._counts = rt.empty(self.total * chunks, np.int32)
        domain = (
            np.int32(stride),
            np.int32(count),
            np.int32(_CHUNK),
            np.int32(chunks),
            self.tile,
            self.tiles,
        )
        group = rt.group()
        rt.launch(self._count, chunks, extents, *domain, self._counts, group=group)
        rt.launch(
            self._within,
            self.total,
            np.int32(self.total),
            np.int32(chunks),
            self._counts,
            self.starts,
            group=group,
        )
        rt.launch(self._starts, 1, np.int32(self.total), self.starts)
        needed = self._total_entries()
        if needed >= _MOST_ENTRIES:
            found, expected = f"{needed} entries or more", f"fewer than {_MOST_ENTRIES}"
            remedy = "use fewer or smaller Gaussians"
            raise MemoryShortage("lists of splats per tile", found, expected, remedy)
        if needed > self.entries.size:
            self.entries = rt.empty(1, np.int32)
            self.entries = rt.empty(min(int(needed * _SLACK) + 16, _MOST_ENTRIES), np.int32)
        rt.launch(
            self._fill,
            chunks,
            extents,
            *domain,
            self._counts,
            self.starts,
            self.entries,
            np.int32(self.entries.size),
            group=group,
        )

    @staticmethod
    def bytes(tiles: int, count: int) -> int:
        """What lists of ``count`` splats take beside their entries."""
        return 4 * (tiles + 1 + tiles * chunks_of(count))

    def _total_entries(self) -> int:
        return int(self.rt.read_item(self.starts, self.total))


def chunks_of(count: int) -> int:
    """Parts in which splats are counted, each by one work-item."""
    return max(-(-count // _CHUNK), 1)
