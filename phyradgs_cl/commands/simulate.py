"""The command simulate: projects a phantom or a volume to a scan file."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from phyradgs_cl.acquisition import PROTOCOLS
from phyradgs_cl.commands.console import file_option, option, pair_of, say
from phyradgs_cl.commands.options import DetectorModel, Device, First, Memory, Output, lengths
from phyradgs_cl.importers.options import DETECTOR_OFFSET
from phyradgs_cl.phantoms import PHANTOMS
from phyradgs_cl.progress import Ticker
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import device_wish
from phyradgs_cl.simulation import OPTION_NAMES, scanner_for, scanner_options
from phyradgs_cl.workflow import refuse_jitter, refuse_noise_options, run_simulation

EXAMPLES = {"simulate": "Example: phyradgs simulate --phantom foot --size 64 --detector 128 --noise tigre -o scan.h5"}
GROUPS = {
    "simulate": {
        "Basics": ("output", "phantom", "volume", "scanner", "protocol", "size", "detector", "noise", "dose", "seed"),
        "Timing": (
            *("turns", "motion_of_object"),
            *("views", "exposure_deg", "fps", "readout_ms", "first"),
            *("start_deg", "jitter_deg", "pulse"),
        ),
        "Panel and beam": (
            *("detector_offset", "truncation", "detector_model", "peak", "electronic_noise", "lag", "rings", "sparks"),
            *("drift", "scatter", "kvp"),
        ),
        "Run": ("pixel_samples", "time_samples", "device", "memory"),
    }
}
ProtocolName = Literal[tuple(PROTOCOLS)]  # type: ignore[valid-type]
Noise = Literal["none", "tigre", "beer"]
_PHANTOM = f"{', '.join(PHANTOMS)}; or a TOML file of beads and wires."
_MOTION = "TOML file of how the object moves: breathing, drying or sliding; the truth of some states is stored."
_NAMES = lambda incomplete: [name for name in PHANTOMS if name.startswith(incomplete)]  # noqa: E731
_VOLUME = "Volume file: HDF5 with /volume (z, y, x), mha, nii, nrrd, npy or tiff."
_PROTOCOL = "rapid: 25 frames of 14.4°; standard: 50 of 7.2°; static: rapid with a gantry that stops."


def simulate_command(
    context: typer.Context,
    output: Output,
    phantom: Annotated[str | None, option(_PHANTOM, "foot, without --volume", autocompletion=_NAMES)] = None,
    volume: Annotated[Path | None, file_option(_VOLUME, "--volume")] = None,
    scanner: Annotated[str, option("Scanner by name (r2, carm, parallel) or a TOML file.")] = "r2",
    protocol: Annotated[ProtocolName, option(_PROTOCOL)] = "rapid",  # type: ignore[valid-type]
    views: Annotated[int | None, option("Frames of the scan.", "protocol's")] = None,
    turns: Annotated[float | None, option("Turns over which the frames are spread; below 0 clockwise.", "1")] = None,
    exposure_deg: Annotated[float | None, option("Arc of one exposure, degrees.", "protocol's")] = None,
    fps: Annotated[float | None, option("Frames per second; states the times of the arcs.", "scanner's")] = None,
    readout_ms: Annotated[float | None, option("Readout in ms, with --fps.", "scanner's, or 0.86 exposures")] = None,
    first: Annotated[First | None, option("Line that is read first, seen from the source.", "scanner's")] = None,
    start_deg: Annotated[float | None, option("Gantry angle at the start, degrees.", "0")] = None,
    pulse: Annotated[
        Any,
        option(
            "When the beam is on, in exposures after a frame's start.", "scanner's: always on",
            parser=pair_of("--pulse", "START,LENGTH as fractions of the exposure", "0.86,0.14"),
            metavar="START,LENGTH",
        ),
    ] = None,
    lag: Annotated[float | None, option("Fraction of a frame's signal from the frames before.", "scanner's: 0")] = None,
    detector_model: Annotated[DetectorModel, option("An exposure averages line integrals (log) or intensity.")] = "log",
    peak: Annotated[float, option("Largest line integral, by scaling the attenuation; 0: unscaled.")] = 0.0,
    noise: Annotated[Noise, option("tigre: TIGRE's rescaled Poisson; beer: Beer-Lambert counts.")] = "none",
    dose: Annotated[float | None, option("Photons per pixel without object.", "10000")] = None,
    electronic_noise: Annotated[float | None, option("Standard deviation of electronic noise, counts.", "10")] = None,
    rings: Annotated[float | None, option("Spread of the pixels' gains (std), seen as rings.", "0")] = None,
    sparks: Annotated[float | None, option("Fraction of all pixels that a spark hits.", "0")] = None,
    drift: Annotated[float | None, option("Largest change of the tube's light from frame to flat.", "0")] = None,
    scatter: Annotated[float | None, option("Scatter over primary light behind the object.", "0")] = None,
    kvp: Annotated[float | None, option("Tube voltage, kV: a beam that hardens.", "0: one energy")] = None,
    truncation: Annotated[float, option("Fraction of the panel's columns cut off, half at each side.")] = 0.0,
    jitter_deg: Annotated[float | None, option("Wander of the gantry (std, degrees), in the encoder table.", "0")] = None,
    motion_of_object: Annotated[Path | None, file_option(_MOTION, "--motion-of-object")] = None,
    detector: Annotated[int | None, option("Detector columns, rows in proportion; same size.", "scanner's")] = None,
    detector_offset: Annotated[Any, lengths("--detector-offset", DETECTOR_OFFSET, "scanner's")] = None,
    size: Annotated[int | None, option("Voxels along the longest side of the truth.", "scanner's or the file's")] = None,
    pixel_samples: Annotated[int, option("Rays along each side of a pixel; 1: its centre; 0: by the voxels.")] = 0,
    time_samples: Annotated[int, option("Times of a line's exposure; 0: by the motion.")] = 0,
    seed: Annotated[int, option("Seed of phantom, noise and jitter.")] = 0,
    device: Device = None,
    memory: Memory = None,
) -> None:
    """Simulate a fly-scan (or a stop-and-shoot one) of a phantom or a volume, and write a scan file."""
    given = {name: value for name, value in context.params.items() if name in OPTION_NAMES}
    refuse_jitter(protocol, jitter_deg)
    refuse_noise_options(noise, {"--dose": dose, "--electronic-noise": electronic_noise})
    wish = device_wish(device)
    described = scanner_for(scanner, detector, detector_offset, truncation)
    options = scanner_options(described, protocol, **given)
    inputs = [Path(one) for one in (scanner if scanner.endswith(".toml") else None, motion_of_object) if one is not None]
    with Ticker("frame") as ticker:
        scan = run_simulation(
            output, described, options, Runtime(wish, memory=memory), ticker.show, phantom=phantom, volume=volume,
            size=size, pixel_samples=pixel_samples, inputs=inputs,
        )
    frames, rows, columns = scan.projections.shape
    say(f"{output}: {frames} frames of {rows}×{columns}, largest line integral {scan.projections.max():.3g}")
