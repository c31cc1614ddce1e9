"""Which workers make the runs: some of this machine, or those of a scheduler that is there already."""

import os
from dataclasses import dataclass

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import DEVICE_VARIABLE, choose_device, list_devices

LOCAL = "local"
_MOST_WORKERS = 1024


@dataclass(frozen=True)
class Workers:
    """Where runs are made. ``scheduler``: ``local``, else the address of a Dask scheduler (``tcp://host:8786``) or its JSON
    file (``dask scheduler --scheduler-file``). ``count``: of local workers; None is one per device. ``device``: what local
    workers' devices are asked for by, several with commas; others have PHYRADGS_DEVICE."""

    scheduler: str = LOCAL
    count: int | None = None
    device: str | None = None

    def __post_init__(self) -> None:
        if not self.scheduler.strip():
            raise InputError("--scheduler", repr(self.scheduler), "local, an address or a scheduler file")
        if self.count is not None:
            checks.within("--workers", self.count, 1, _MOST_WORKERS)
        if self.is_local:
            return
        remedy = "leave it out: the workers of that scheduler are taken"
        if self.count is not None:
            found = f"{self.count} beside --scheduler {self.scheduler}"
            raise InputError("--workers", found, "a number of local workers", remedy)
        if self.device is not None:
            found = f"{self.device!r} beside --scheduler {self.scheduler}"
            expected = f"{DEVICE_VARIABLE} in the environment of each worker"
            raise InputError("--device", found, expected, "leave it out")

    @property
    def is_local(self) -> bool:
        return self.scheduler == LOCAL

    def devices(self) -> list[str]:
        """The device of each local worker, as ``choose_device`` takes it; DeviceError where one is not there."""
        wishes = _wishes(self.device or os.environ.get(DEVICE_VARIABLE))
        count = len(wishes) if self.count is None else self.count
        return [wishes[worker % len(wishes)] for worker in range(count)]


def _wishes(device: str | None) -> list[str]:
    """One per device: those with commas between them; all GPUs for ``gpu`` and for none on a machine with GPUs."""
    if device is None or device.lower() == "gpu":
        best, _ = choose_device(device)
        if best.kind != "gpu":
            return [str(best.index)]
        return [str(d.index) for d in list_devices() if d.kind == "gpu" and d.by_default]
    wishes = [part.strip() for part in device.split(",")]
    for wish in wishes:
        if not wish:
            raise InputError("--device", repr(device), "devices with commas between them")
        choose_device(wish)
    return wishes
