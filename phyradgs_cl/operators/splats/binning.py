"""Lists of the splats (projected Gaussians) in each tile of an image, by a stable counting sort on the device."""

import numpy as np

from phyradgs_cl.checks import ceil_div
from phyradgs_cl.runtime import DeviceArray, LaterItem, MemoryShortage, Runtime

_CHUNK = 512  # number of splats whose tiles one work-item of a CPU counts
_GROUP = 64  # number of splats whose tiles one work-group of a GPU counts
_LARGEST_GROUP = 256  # most splats per work-group of a GPU, taken if _GROUP would give more than _MANY_COUNTS counts
_MANY_COUNTS = 1 << 22  # above this many counts, tiles × work-groups, counting takes much memory and time
_SCANNED = 64  # number of counts that a work-group adds at a time in the running sums that give list positions
_SLACK = 1.5  # new lists get memory for this many times the entries needed, because the number of Gaussians grows
_NEAR = 1.25  # lists with memory for less than this many times the entries needed are replaced before they overflow
# A launch whose lists overflow tests every splat at every pixel. Above this many tests, a second on a fast GPU, the host
# waits for the lists' size instead.
_MOST_CHECKS = 2**38
_MOST_ENTRIES = 2**31 - 1  # all lists together must have fewer entries than this: kernels use 32-bit indices


class TileLists:
    """Builds a list, for each tile of an image or volume, of the splats (projected Gaussians) that touch it.

    tile: a tile's size in pixels or voxels along x, y, z. tiles: the number of tiles along x, y, z. A list keeps the order
    of the splats, so that sums over it repeat bit for bit. The number of list entries is known only on the device. The host
    waits for it if the number of splats is new, if ``waits`` is set, or if a GPU would take long without lists. Else the
    host reads it later. Until then, kernels test all splats in a tile whose list did not fit (cl/common/tile.h)."""

    def __init__(self, rt: Runtime, tile: tuple[int, int, int], tiles: tuple[int, int, int]) -> None:
        self.rt = rt
        self.total = int(np.prod(tiles))
        self.tile = np.array([*tile, 0], np.int32)
        self.tiles = np.array([*tiles, 0], np.int32)
        self.waits = False
        self.tile_offsets = rt.zeros(self.total + 1, np.int32)
        self.splat_ids = rt.empty(1, np.int32)
        self._counts: DeviceArray = rt.empty(1, np.int32)
        self._count_seen = -1
        self._needed: LaterItem | None = None
        shape = "_group" if rt.pixel_items else ""
        self._count, self._within, self._starts, self._fill = (
            rt.kernel("binning", f"bin_{step}{shape}") for step in ("count", "within", "starts", "fill")
        )

    @property
    def samples(self) -> int:
        """The most work of a launch (``samples`` of ``Runtime.launch``): list entries times pixels (or voxels) in a tile."""
        return self.splat_ids.size * int(np.prod(self.tile[:3], dtype=np.int64))

    def build(self, extents: DeviceArray, count: int, stride: int, cells: int = 1) -> None:
        """Fills ``tile_offsets`` (tiles + 1,) and ``splat_ids`` for ``count`` splats. extents (6, stride): a splat's first
        and last pixel or voxel along x, y, z. cells: the number of time cells from which each splat was projected.

        Raises MemoryShortage for 2^31 − 1 list entries or more, since a smaller part of a volume may have fewer."""
        rt = self.rt
        chunk = chunk_of(rt, self.total, count)
        chunks = max(ceil_div(count, chunk), 1)
        if self._counts.size < self.total * chunks:
            self._counts = rt.empty(1, np.int32)  # frees the old memory now, so that the device need not hold both
            self._counts = rt.empty(self.total * chunks, np.int32)
        domain = extents, stride, count, chunk, chunks, self.tile, self.tiles
        group = chunk if rt.pixel_items else 1
        scan = rt.group(1, _SCANNED, self._within, self._starts)
        boxes, scratch = ([rt.local(24 * group)], [rt.local(8 * scan)]) if rt.pixel_items else ([], [])
        if rt.pixel_items:
            rt.fill(self._counts, 0)
        rt.launch(self._count, chunks * group, *domain, self._counts, *boxes, group=group)
        rt.launch(
            self._within, self.total * scan, self.total, chunks, self._counts, self.tile_offsets, *scratch,
            group=scan,
        )  # fmt: skip
        rt.launch(self._starts, scan, self.total, self.tile_offsets, *scratch, group=scan)
        checks = self.total * int(np.prod(self.tile[:3], dtype=np.int64)) * count * cells
        if self.waits or count != self._count_seen or (rt.pixel_items and checks > _MOST_CHECKS):
            self._make_room(int(rt.read_item(self.tile_offsets, self.total)), 1.0)
            self._count_seen, self._needed = count, None
        elif self._needed is not None and self._needed.is_here:
            self._make_room(int(self._needed.value), _NEAR)
            self._needed = None
        rt.launch(
            self._fill, chunks * group, *domain, self._counts, self.tile_offsets, self.splat_ids,
            self.splat_ids.size, *boxes, group=group,
        )  # fmt: skip
        if not self.waits and self._needed is None:
            self._needed = rt.read_item_later(self.tile_offsets, self.total)

    @staticmethod
    def bytes(rt: Runtime, tiles: int, count: int) -> int:
        """Returns how many bytes the offsets and counts of the lists of ``count`` splats take, without the entries."""
        return 4 * (tiles + 1 + tiles * max(ceil_div(count, chunk_of(rt, tiles, count)), 1))

    def _make_room(self, needed: int, share: float) -> None:
        """Allocates memory for more than ``needed`` list entries, unless there is room for ``share`` · ``needed`` already.
        Raises MemoryShortage for more entries than 32-bit indices can count."""
        if needed >= _MOST_ENTRIES:
            found, expected = f"{needed} entries or more", f"fewer than {_MOST_ENTRIES}"
            remedy = "use fewer or smaller Gaussians"
            raise MemoryShortage("lists of splats per tile", found, expected, remedy)
        if share * needed > self.splat_ids.size:
            self.splat_ids = self.rt.empty(1, np.int32)
            self.splat_ids = self.rt.empty(min(int(needed * _SLACK) + 16, _MOST_ENTRIES), np.int32)


def chunk_of(rt: Runtime, tiles: int, count: int) -> int:
    """Returns the number of splats that a CPU's work-item counts, or a GPU's work-group with one splat per work-item."""
    if not rt.pixel_items:
        return _CHUNK
    kernels = (rt.kernel("binning", f"bin_{step}_group") for step in ("count", "fill"))
    largest = rt.group(1, _LARGEST_GROUP, *kernels)
    chunk = min(_GROUP, largest)
    while 2 * chunk <= largest and tiles * ceil_div(count, chunk) > _MANY_COUNTS:
        chunk *= 2
    return chunk
