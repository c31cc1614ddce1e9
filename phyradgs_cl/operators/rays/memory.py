"""The device memory of ray-driven operators: a volume, whole or a brick at a time, and the frames of a batch."""

from collections.abc import Iterator

import numpy as np

from phyradgs_cl.acquisition.readout import Readout
from phyradgs_cl.fields import triple
from phyradgs_cl.operators.bricks import Brick, cut, whole
from phyradgs_cl.operators.rays.launches import owner_steps
from phyradgs_cl.operators.rays.layout import RayLayout
from phyradgs_cl.operators.rays.upright import columns_floats, turn_volume
from phyradgs_cl.runtime import Array, DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD, Strides, move, pad_rows, unpad_rows

_FRAMES_SHARE = 0.25  # of the room, for frames beside a brick
_SLOTS_SHARE = 0.125  # of the room, for slots of frames
_MOST_SLOT_FLOATS = 2**26  # for the slots of some frames at a time: more would not be faster


class RayMemory:
    """Buffers for frames of ``layout`` and its volume, planned when they are first needed.

    A volume that fits stays whole; else it is cut into bricks, each as large as fits beside some frames. slot_floats: what
    the slots of a frame take (``slots.py``); the volume is then wanted turned as well, where both fit, and so are frames; 0:
    no slots. Operators may share one, in turns: each call writes what it reads.
    """

    def __init__(self, rt: Runtime, layout: RayLayout, most_frames: int, slot_floats: int = 0) -> None:
        self.rt, self.layout, self.most_frames = rt, layout, most_frames
        self.slot_floats = slot_floats
        self.slot_frames = 0
        self._columns_bytes = 4 * columns_floats(layout.grid) if slot_floats else 0
        self._columns: DeviceArray | None = None
        self._slots: DeviceArray | None = None
        self._bricks: list[Brick] = []
        self._batch = 0
        self._volume: DeviceArray | None = None
        self._bordered: tuple[int, int, int] | None = None  # the shape of brick around which zeros lie
        self._frames: DeviceArray | None = None
        self._padded: dict[tuple[int, int, int], np.ndarray] = {}

    def plan(self, share: float = 1.0) -> list[Brick]:
        """The bricks. A share below 1 plans anew, for so much of the room."""
        if not self._bricks or share < 1:
            self._volume = self._frames = self._columns = self._slots = None
            self._padded.clear()
            self._bricks, self._batch = self._planned(share)
        return self._bricks

    def _planned(self, share: float) -> tuple[list[Brick], int]:
        layout, room = self.layout, self.rt.room()
        each_bytes = 4 * (self._frames_floats(1) - layout.frames_floats(0))
        if self.slot_floats:
            fitting = min(int(_SLOTS_SHARE * share * room.free_bytes) // 4, _MOST_SLOT_FLOATS) // self.slot_floats
            self.slot_frames = min(self.most_frames, fitting)
        slots_bytes = 4 * self._slots_floats

        def batch(free_bytes: int) -> int:
            fitting = (min(free_bytes - slots_bytes, room.largest_bytes) - 4 * layout.frames_floats(0)) // each_bytes
            return max(1, min(self.most_frames, fitting))

        everything = whole(layout.grid.shape)
        volume_bytes = 4 * layout.of(everything).volume_floats
        if share == 1 and room.holds(volume_bytes, 4 * self._frames_floats(1), slots_bytes):
            if not room.holds(volume_bytes, 4 * self._frames_floats(1), slots_bytes, self._columns_bytes):
                self._columns_bytes = 0
            return [everything], batch(room.free_bytes - volume_bytes - self._columns_bytes)
        self._columns_bytes = 0
        steps = owner_steps(self.rt)
        smallest = triple(
            min(n, step) for n, step in zip(layout.grid.shape, (*steps, layout.grid.shape[2]), strict=True)
        )
        beside = room.free_bytes - 4 * layout.of(whole(smallest)).volume_floats
        frames = batch(min(int(_FRAMES_SHARE * share * room.free_bytes), beside))

        def needs(shape: tuple[int, int, int]) -> tuple[int, ...]:
            return 4 * layout.of(whole(shape)).volume_floats, 4 * self._frames_floats(frames), slots_bytes

        return cut(layout.grid.shape, steps, needs, room, share), frames

    def batches(self, count: int) -> Iterator[slice]:
        """Runs of frames that fit beside each other."""
        self.plan()
        for start in range(0, count, self._batch):
            yield slice(start, min(start + self._batch, count))

    def holds_all(self, frames: int) -> bool:
        """Whether a whole volume and so many frames fit beside each other; if so, that memory is taken now."""
        if len(self.plan()) > 1 or self._batch < frames:
            return False
        self.volume(self._bricks[0])
        self.frames(frames)
        if self._columns_bytes and self._columns is None:
            self._columns = self.rt.zeros(self._columns_bytes // 4)
        if self.slot_frames:
            self.slots()
        return True

    def volume(self, brick: Brick) -> tuple[RayLayout, DeviceArray]:
        """Memory for a brick, whatever is in it."""
        if self._volume is None:
            largest = self._bricks[0]
            self._volume = self.rt.zeros(self.layout.of(largest).volume_floats)
            self._bordered = largest.shape
        layout = self.layout.of(brick)
        if brick.shape != self._bordered:  # the borders of the shape before are voxels now
            self._bordered = None
        return layout, DeviceArray(self._volume.buffer, (layout.volume_floats,), self._volume.dtype)

    def write_volume(self, volume: Array, brick: Brick) -> tuple[RayLayout, DeviceArray]:
        """A brick of a volume (z, y, x) in the padded layout.

        Of a host's volume the padded floats are kept: fresh pages cost more than the copy.
        """
        layout, on_device = self.volume(brick)
        if isinstance(volume, DeviceArray):
            if self._bordered != brick.shape:
                self.rt.fill(on_device, 0)
            plain = Strides.plain(volume.shape, brick.start)
            move(self.rt, (volume, plain), (on_device, layout.volume_strides), brick.shape)
            self._bordered = brick.shape
            return layout, on_device
        self._bordered = brick.shape
        if brick.shape not in self._padded:
            self._padded = {brick.shape: np.zeros(layout.volume_floats, np.float32)}
        padded = self._padded[brick.shape]
        layout.inside(padded)[...] = volume[brick.box]
        self.rt.write(on_device, padded)
        return layout, on_device

    def read_volume(self, layout: RayLayout, on_device: DeviceArray, result: Array) -> None:
        """A padded brick to its place in a volume (z, y, x)."""
        brick = layout.brick
        if isinstance(result, DeviceArray):
            plain = Strides.plain(result.shape, brick.start)
            move(self.rt, (on_device, layout.volume_strides), (result, plain), brick.shape)
        else:
            result[brick.box] = layout.inside(self.rt.download(on_device))

    @property
    def has_columns(self) -> bool:
        """Whether there is room for a whole volume with z along a row, after ``plan``."""
        return self._columns_bytes > 0

    def turned(self, volume: Array) -> DeviceArray:
        """A whole volume (z, y, x) with z along a row: a device array as it lies, a host's by way of the padded layout."""
        if self._columns is None:
            self._columns = self.rt.zeros(self._columns_bytes // 4)
        if isinstance(volume, DeviceArray):
            turn_volume(self.rt, self.layout, (volume, Strides.plain(volume.shape)), self._columns)
        else:
            layout, padded = self.write_volume(volume, self._bricks[0])
            turn_volume(self.rt, layout, (padded, layout.volume_strides), self._columns)
        return self._columns

    def slots(self) -> DeviceArray:
        """Memory for the slots of ``slot_frames`` frames, whatever was in it. There is none where the room is too small."""
        if self._slots is None:
            self._slots = self.rt.zeros(self._slots_floats)
        return self._slots

    @property
    def _slots_floats(self) -> int:
        return 2 * GUARD + self.slot_frames * self.slot_floats if self.slot_frames else 0

    def frames(self, count: int) -> DeviceArray:
        """Memory for ``count`` frames of one batch, whatever was in it."""
        return self._some_frames(self.layout.frames_floats(count))

    def _some_frames(self, floats: int) -> DeviceArray:
        if self._frames is None:
            self._frames = self.rt.zeros(self._frames_floats(self._batch))
        return DeviceArray(self._frames.buffer, (floats,), self._frames.dtype)

    def _frames_floats(self, count: int) -> int:
        """Of frames that lie either way, where both are wanted."""
        turned = self.layout.turned_floats(count) if self.slot_floats else 0
        return max(self.layout.frames_floats(count), turned)

    def write_frames(self, frames: Array, part: slice, axis: str) -> DeviceArray:
        """Some of the frames (F, rows, columns), lines first and padded; ``axis`` is the readout's."""
        count = part.stop - part.start
        on_device = self.frames(count)
        if isinstance(frames, DeviceArray):
            plain = Strides.plain(frames.shape, (part.start, 0, 0))
            shape = count, *frames.shape[1:]
            padded = on_device, self.layout.frames_strides
            move(self.rt, (frames, plain), padded, shape, turned=axis == "columns")
        else:
            self.rt.write(on_device, pad_rows(Readout(axis).frames(frames[part])))
        return on_device

    def write_turned(self, frames: Array, part: slice, axis: str) -> DeviceArray:
        """As ``write_frames``, with lines as columns."""
        count = part.stop - part.start
        on_device = self._some_frames(self.layout.turned_floats(count))
        if isinstance(frames, DeviceArray):
            plain = Strides.plain(frames.shape, (part.start, 0, 0))
            shape = count, *frames.shape[1:]
            move(self.rt, (frames, plain), (on_device, self.layout.turned_strides), shape, turned=axis == "rows")
        else:
            self.rt.write(on_device, pad_rows(Readout(axis).frames(frames[part]).swapaxes(1, 2)))
        return on_device

    def read_frames(self, on_device: DeviceArray, result: Array, part: slice, axis: str) -> None:
        """The inverse of ``write_frames``: padded frames to their place among ``result`` (F, rows, columns)."""
        shape = self.layout.frames_shape(part.stop - part.start)
        if isinstance(result, DeviceArray):
            plain = Strides.plain(result.shape, (part.start, 0, 0))
            padded = on_device, self.layout.frames_strides
            move(self.rt, padded, (result, plain), shape, turned=axis == "columns")
        else:
            result[part] = Readout(axis).frames(unpad_rows(self.rt.download(on_device), shape))
