"""Device memory of ray-driven operators: buffers for a volume or a part of it (brick), for some frames (batch), and for the
line integrals of single poses (slots, see ``slots.py``)."""

from collections.abc import Iterator

import numpy as np

from phyradgs_cl.acquisition.readout import Readout
from phyradgs_cl.fields import triple
from phyradgs_cl.operators.bricks import Brick, cut, whole
from phyradgs_cl.operators.rays.general import owner_steps
from phyradgs_cl.operators.rays.layout import RayLayout
from phyradgs_cl.operators.rays.subrays import SINGLE, launch_means, launch_spread, means, spread
from phyradgs_cl.operators.rays.upright import columns_floats, turn_volume
from phyradgs_cl.runtime import Array, DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD, Strides, move, pad_rows, unpad_rows

_FRAMES_SHARE = 0.25  # fraction of the free device memory for a batch of frames if the volume does not fit as a whole
_SLOTS_SHARE = 0.125  # fraction of the free device memory for slots, the line integrals of single poses
_MOST_SLOT_FLOATS = 2**26  # most floats that all slots take at one time: more was not faster


class RayMemory:
    """Buffers for a volume and frames of ``layout``. Their sizes are chosen at the first use, by the memory that is free
    then.

    A volume that does not fit is cut into bricks, as large as fit together with some frames. slot_floats: the floats of
    one frame's slots (line integrals of single poses), 0 without slots. With slots the volume is also stored transposed,
    with z along rows, if both fit. Several operators may share one memory if they run one after the other, since no call
    needs values of an earlier call."""

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
        self._bordered: tuple[int, int, int] | None = None  # shape of the brick for which the volume's border is zero
        self._frames: DeviceArray | None = None
        self._padded: dict[tuple[int, int, int], np.ndarray] = {}

    def plan(self, share: float = 1.0) -> list[Brick]:
        """Returns the bricks (parts) of the volume. A ``share`` below 1 makes new ones, for that fraction of the free
        memory. Raises OutOfMemoryError if no brick fits."""
        if not self._bricks or share < 1:
            self.release()
            self._bricks, self._batch = self._planned(share)
        return self._bricks

    @property
    def planned_bytes(self) -> int:
        """The bytes of all buffers, even if not yet allocated; 0 before ``plan``."""
        if not self._bricks:
            return 0
        floats = self.layout.of(self._bricks[0]).volume_floats + self._frames_floats(self._batch) + self._slots_floats
        return 4 * floats + self._columns_bytes

    def release(self) -> None:
        """Frees the buffers. The next use chooses their sizes by the memory that is free then."""
        self._volume = self._frames = self._columns = self._slots = None
        self._padded.clear()
        self._bricks = []

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
        """Yields slices of the first ``count`` frames. The frames of a slice fit on the device together."""
        self.plan()
        for start in range(0, count, self._batch):
            yield slice(start, min(start + self._batch, count))

    def holds_all(self, frames: int) -> bool:
        """Returns whether the whole volume and ``frames`` frames fit together. If so, allocates their buffers."""
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
        """Returns the layout of a brick (part of the volume), and memory for it with undefined values."""
        if self._volume is None:
            largest = self._bricks[0]
            self._volume = self.rt.zeros(self.layout.of(largest).volume_floats)
            self._bordered = largest.shape
        layout = self.layout.of(brick)
        if brick.shape != self._bordered:  # a brick of another shape has its border where the last one had voxels
            self._bordered = None
        return layout, DeviceArray(self._volume.buffer, (layout.volume_floats,), self._volume.dtype)

    def write_volume(self, volume: Array, brick: Brick) -> tuple[RayLayout, DeviceArray]:
        """Copies a brick (part) of a volume (nz, ny, nx) to the device. Returns the brick's layout and the padded copy.

        The padded array on the host is kept for the next call: allocating it takes longer than the copy."""
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
        """Copies a padded brick (part) from the device into the volume ``result`` (nz, ny, nx)."""
        brick = layout.brick
        if isinstance(result, DeviceArray):
            plain = Strides.plain(result.shape, brick.start)
            move(self.rt, (on_device, layout.volume_strides), (result, plain), brick.shape)
        else:
            result[brick.box] = layout.inside(self.rt.download(on_device))

    @property
    def has_columns(self) -> bool:
        """Whether a transposed copy of the volume fits on the device beside the volume. Known after ``plan``."""
        return self._columns_bytes > 0

    def turned(self, volume: Array) -> DeviceArray:
        """Returns the whole volume (nz, ny, nx) on the device, padded and transposed to (y, x, z)."""
        if self._columns is None:
            self._columns = self.rt.zeros(self._columns_bytes // 4)
        if isinstance(volume, DeviceArray):
            turn_volume(self.rt, self.layout, (volume, Strides.plain(volume.shape)), self._columns)
        else:
            layout, padded = self.write_volume(volume, self._bricks[0])
            turn_volume(self.rt, layout, (padded, layout.volume_strides), self._columns)
        return self._columns

    def slots(self) -> DeviceArray:
        """Returns memory for the slots (line integrals of single poses) of ``slot_frames`` frames, with undefined values."""
        if self._slots is None:
            self._slots = self.rt.zeros(self._slots_floats)
        return self._slots

    @property
    def _slots_floats(self) -> int:
        return 2 * GUARD + self.slot_frames * self.slot_floats if self.slot_frames else 0

    def frames(self, count: int) -> DeviceArray:
        """Returns memory for ``count`` padded frames, with undefined values."""
        return self._some_frames(self.layout.frames_floats(count))

    def _some_frames(self, floats: int) -> DeviceArray:
        if self._frames is None:
            self._frames = self.rt.zeros(self._frames_floats(self._batch))
        return DeviceArray(self._frames.buffer, (floats,), self._frames.dtype)

    def _frames_floats(self, count: int) -> int:
        """Returns how many floats a buffer for ``count`` frames takes. With slots it also holds the frames transposed."""
        turned = self.layout.turned.frames_floats(count) if self.slot_floats else 0
        return max(self.layout.frames_floats(count), turned)

    def write_frames(self, frames: Array, part: slice, axis: str, *, turned: bool = False) -> DeviceArray:
        """Copies the frames ``part`` of a stack (F, rows, columns) to the device, padded. Lines along ``axis`` become rows
        of the copy, or its columns if ``turned``."""
        count, layout = part.stop - part.start, self.layout
        on_device = self._some_frames(layout.turned.frames_floats(count)) if turned else self.frames(count)
        if layout.subrays != SINGLE and isinstance(frames, DeviceArray):
            strides = layout.pixel_strides(axis, turned=turned)
            launch_spread(self.rt, frames, part, layout.subrays, on_device, strides)
        elif isinstance(frames, DeviceArray):
            source = frames, Strides.plain(frames.shape, (part.start, 0, 0))
            padded = on_device, (layout.turned if turned else layout).frames_strides
            move(self.rt, source, padded, (count, *frames.shape[1:]), turned=turned != (axis == "columns"))
        else:
            chosen = frames[part] if layout.subrays == SINGLE else spread(frames[part], layout.subrays)
            lines = Readout(axis).frames(chosen)
            self.rt.write(on_device, pad_rows(lines.swapaxes(1, 2) if turned else lines))
        return on_device

    def read_frames(self, on_device: DeviceArray, result: Array, part: slice, axis: str) -> None:
        """Copies padded frames to the frames ``part`` of ``result`` (F, rows, columns). Sub-rays of a pixel are averaged."""
        shape, subrays = self.layout.frames_shape(part.stop - part.start), self.layout.subrays
        if subrays != SINGLE and isinstance(result, DeviceArray):
            launch_means(self.rt, on_device, self.layout.pixel_strides(axis), subrays, result, part)
        elif isinstance(result, DeviceArray):
            plain = Strides.plain(result.shape, (part.start, 0, 0))
            padded = on_device, self.layout.frames_strides
            move(self.rt, padded, (result, plain), shape, turned=axis == "columns")
        else:
            frames = Readout(axis).frames(unpad_rows(self.rt.download(on_device), shape))
            result[part] = frames if subrays == SINGLE else means(frames, subrays)
