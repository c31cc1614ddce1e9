"""A volume of every scan in a folder, as it arrives: python watch_folder.py INCOMING VOLUMES --method fista-tv

VOLUMES/NAME.log holds the words or the error of the run of NAME.h5, and the version of the scan. A scan that has changed,
or whose log was removed, is made again. Options are those of phyradgs reconstruct. Kill it at any moment.
"""

import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from watchfiles import watch

NOT_THE_SCANS = (4, 5, 130, 143)  # a full disk or another run there, no device, Ctrl-C, SIGTERM: it is tried again


def version(scan: Path) -> str:
    return f"{scan.name}: {scan.stat().st_size} bytes, changed at {scan.stat().st_mtime_ns} ns\n"


def make(scan: Path, volume: Path, words: list[str]) -> None:
    began, log = version(scan), volume.with_suffix(".log")
    if log.exists() and log.read_text(encoding="utf-8").startswith(began):
        return
    resume = ["--resume"] if Path(f"{volume}.checkpoint.npz").exists() else []
    command = [sys.executable, "-m", "phyradgs_cl", "reconstruct", str(scan), "-o", str(volume), *words, *resume]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    print(f"{scan}: status {done.returncode}\n{done.stdout}", flush=True)
    if done.returncode not in NOT_THE_SCANS and version(scan) == began:  # else more of it has come: made again
        log.write_text(began + done.stdout, encoding="utf-8")


incoming, volumes = Path(sys.argv[1]), Path(sys.argv[2])
volumes.mkdir(exist_ok=True)
for _ in watch(incoming, recursive=False, yield_on_timeout=True, rust_timeout=2000):  # some disks tell of no change
    for arrived in sorted(incoming.glob("[!.]*.h5")):
        with suppress(FileNotFoundError):  # taken away in the meantime
            make(arrived, volumes / arrived.name, words=sys.argv[3:])
