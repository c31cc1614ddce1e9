"""splat: Gaussians fitted to a volume."""

import json
from pathlib import Path
from typing import Annotated, Any

from phyradgs_cl.commands.console import AsJson, file_argument, file_option, option, say
from phyradgs_cl.commands.options import Device, numbers
from phyradgs_cl.metrics import printed
from phyradgs_cl.progress import Ticker
from phyradgs_cl.reconstructors.splats.volume_fit import VolumeFitOptions
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import device_wish
from phyradgs_cl.workflow import run_splat_fit

EXAMPLES = {"splat": "Example: phyradgs splat volume.h5 -o cloud.ply --gaussians 20000"}
GROUPS = {"splat": {"Basics": ("output", "gaussians", "iterations", "as_json"), "Run": ("voxel_mm", "seed", "device")}}
_OUTPUT = "File to write: .ply or .npz of the Gaussians, .h5 with their field too."
_VOXEL = "Sides of the voxels of a volume without a scale, mm."


def splat_command(
    volume: Annotated[Path, file_argument("VOLUME", "Volume file: ours, or mha, nii, nrrd, npy, tiff.")],
    output: Annotated[Path, file_option(_OUTPUT, "--output", "-o")],
    gaussians: Annotated[int, option("Gaussians; their number does not grow.", "one for 16 voxels, 1000 to 50000")] = 0,
    iterations: Annotated[int, option("Steps of Adam, each of all voxels.")] = VolumeFitOptions().iterations,
    as_json: AsJson = False,
    voxel_mm: Annotated[Any, option(_VOXEL, "the file's", parser=numbers, metavar="D|Z,Y,X")] = None,
    seed: Annotated[int, option("Seed of the start.", min=0)] = 0, device: Device = None,
) -> None:
    """Fit Gaussians to a volume: write the cloud, print its error and the compression.

    The start is drawn from the volume's gradient, then all parameters descend on the error of the voxels. Ctrl-C writes
    nothing."""
    options, wish = VolumeFitOptions(gaussians, iterations), device_wish(device)
    with Ticker("iteration") as ticker:
        ticker.stage("building kernels")
        facts = run_splat_fit(
            volume, output, options, lambda: Runtime(wish), ticker.progress, seed=seed, voxel_mm=voxel_mm
        )
    if as_json:
        say(json.dumps(facts, default=float))
        return
    words = ", ".join(f"{title} {value}" for title, value in printed(facts))
    asked = f" of {gaussians}, as many as there are places" if gaussians > int(str(facts["gaussians"])) else ""
    cloud = f"{facts['gaussians']} Gaussians{asked}, voxels / parameters {facts['compression']:.3g}"
    say(f"{output}: {cloud}, {words}, {facts['seconds']:.1f} s")
