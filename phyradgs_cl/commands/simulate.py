"""The command simulate: projects a phantom or a volume to a scan file."""

from pathlib import Path
from typing import Annotated, Any, Literal

from phyradgs_cl.acquisition import PROTOCOLS, Protocol
from phyradgs_cl.commands.console import file_option, option, pair_option, say
from phyradgs_cl.commands.options import Device, First, Memory, Output, lengths, of_fields, with_options
from phyradgs_cl.importers.options import DETECTOR_OFFSET
from phyradgs_cl.phantoms import PHANTOMS
from phyradgs_cl.progress import Ticker
from phyradgs_cl.settings import runtime_for
from phyradgs_cl.simulation import SimulationOptions, scanner_for, scanner_options
from phyradgs_cl.workflow import run_simulation

EXAMPLES = {"simulate": "Example: phyradgs simulate --phantom foot --size 64 --detector 128 --noise tigre -o scan.h5"}
GROUPS = {"simulate": {
    "Basics": ("output", "phantom", "volume", "scanner", "protocol", "size", "detector", "noise", "dose", "seed"),
    "Timing": (
        "turns", "motion_of_object", "views", "exposure_deg", "fps", "readout_ms", "first", "start_deg", "jitter_deg",
        "pulse",
    ),
    "Panel and beam": (
        "detector_offset", "truncation", "detector_model", "peak", "electronic_noise", "lag", "rings", "sparks",
        "drift", "scatter", "kvp",
    ),
    "Run": ("pixel_samples", "time_samples", "device", "memory"),
}}
ProtocolName = Literal[tuple(PROTOCOLS)]  # type: ignore[valid-type]
_PHANTOM = f"{', '.join(PHANTOMS)}; or a TOML file of beads and wires."
_NAMES = lambda incomplete: [name for name in PHANTOMS if name.startswith(incomplete)]  # noqa: E731
_VOLUME = "Volume file: HDF5 with /volume (z, y, x), mha, nii, nrrd, npy or tiff."
_PROTOCOL = "rapid: 25 frames of 14.4°; standard: 50 of 7.2°; static: rapid with a gantry that stops."
_MAKERS = {
    "pulse": pair_option("START,LENGTH as fractions of the exposure", "0.86,0.14", "START,LENGTH"),
    "motion_of_object": lambda flag, help, usual: file_option(help, flag, default=usual),
}
_OPTIONS = {**of_fields(Protocol, **_MAKERS), **of_fields(SimulationOptions, **_MAKERS)}


@with_options("given", _OPTIONS, dict)
def simulate_command(
    output: Output,
    given: dict[str, Any],
    phantom: Annotated[str | None, option(_PHANTOM, "foot, without --volume", autocompletion=_NAMES)] = None,
    volume: Annotated[Path | None, file_option(_VOLUME, "--volume")] = None,
    scanner: Annotated[str, option("Scanner by name (r2, carm, parallel) or a TOML file.")] = "r2",
    protocol: Annotated[ProtocolName, option(_PROTOCOL)] = "rapid",  # type: ignore[valid-type]
    fps: Annotated[float | None, option("Frames per second; states the times of the arcs.", "scanner's")] = None,
    readout_ms: Annotated[float | None, option("Readout in ms, with --fps.", "scanner's, or 0.86 exposures")] = None,
    first: Annotated[First | None, option("Line that is read first, seen from the source.", "scanner's")] = None,
    truncation: Annotated[float, option("Fraction of the panel's columns cut off, half at each side.")] = 0.0,
    detector: Annotated[int | None, option("Detector columns, rows in proportion; same size.", "scanner's")] = None,
    detector_offset: Annotated[Any, lengths("--detector-offset", DETECTOR_OFFSET, "scanner's")] = None,
    size: Annotated[int | None, option("Voxels along the longest side of the truth.", "scanner's or the file's")] = None,
    pixel_samples: Annotated[int, option("Rays along each side of a pixel; 1: its centre; 0: by the voxels.")] = 0,
    device: Device = None,
    memory: Memory = None,
) -> None:
    """Simulate a fly-scan (or a stop-and-shoot one) of a phantom or a volume, and write a scan file."""
    described = scanner_for(scanner, detector, detector_offset, truncation)
    options = scanner_options(described, protocol, fps=fps, readout_ms=readout_ms, first=first, **given)
    of_scanner = scanner if scanner.endswith(".toml") else None
    inputs = [Path(one) for one in (of_scanner, given["motion_of_object"]) if one is not None]
    with Ticker("frame") as ticker:
        scan = run_simulation(
            output, described, options, runtime_for(device, memory), ticker.show, phantom=phantom, volume=volume, size=size,
            pixel_samples=pixel_samples, inputs=inputs,
        )
    frames, rows, columns = scan.projections.shape
    say(f"{output}: {frames} frames of {rows}×{columns}, largest line integral {scan.projections.max():.3g}")
