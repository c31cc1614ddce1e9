"""The command evaluate: compares a volume with a reference, such as a scan's true volume."""

from pathlib import Path
from typing import Annotated, Any

from phyradgs_cl.commands.console import (
    AsJson,
    file_argument,
    file_option,
    numbers,
    option,
    say,
    say_json,
    told,
)
from phyradgs_cl.metrics import COVERAGE, METRICS
from phyradgs_cl.workflow import run_evaluation

EXAMPLES = {"evaluate": "Example: phyradgs evaluate volume.h5 --reference scan.h5 --json"}
_REFERENCE = (
    "Scan with a known truth, or a volume. One with voxels an integer multiple finer is averaged onto VOLUME's grid; else "
    "VOLUME is resampled onto the reference's (linear)."
)
_VOXEL = "Sides of the voxels of a reference without a scale, mm; it is centred on the axis."
_OF_RTK = "The reference is a volume of RTK, whose axis of rotation is y."
_WATER = "Attenuation of water in 1/mm, near 0.02, for a file in Hounsfield units that does not state its scale."
_MOTION = "Deformation of the object: VOLUME is compared with the truth of every state."
_PICTURE = "PNG of slices: result, truth, difference."


def evaluate_command(
    volume: Annotated[Path, file_argument("VOLUME", "Volume file: ours, or mha, nii, nrrd, npy, tiff, zarr.")],
    reference: Annotated[Path, file_option(_REFERENCE, "--reference")], as_json: AsJson = False,
    reference_voxel_mm: Annotated[Any, option(_VOXEL, "the file's", parser=numbers, metavar="D|Z,Y,X")] = None,
    rtk_reference: Annotated[bool, option(_OF_RTK, True, "--rtk-reference")] = False,
    mu_water_per_mm: Annotated[float | None, option(_WATER, "the file's", "--mu-water-per-mm")] = None,
    object_motion: Annotated[Path | None, file_option(_MOTION, "--object-motion")] = None,
    picture: Annotated[Path | None, file_option(_PICTURE, "--picture", default="v.evaluated.png for v.h5")] = None,
) -> None:
    """Measure a volume against the truth: 3D PSNR and SSIM, and a picture of slices."""
    stem = volume.stem if volume.suffix in ("", ".h5") else volume.name  # so that v.h5 and v.nii get different pictures
    usual = volume.with_name(f"{stem}.evaluated.png")  # not v.png, which may be the run's preview
    facts = run_evaluation(
        volume, reference, picture or usual, reference_voxel_mm, object_motion, rtk_reference, mu_water_per_mm
    )
    if as_json:
        say_json(facts)
        return
    say("   ".join([*told(facts), str(facts["compared"]), f"picture {facts['picture']}"]))
    if "reliability" in facts:
        say(f"error bars: {'   '.join(told(facts, COVERAGE))}   picture {facts['reliability']}")
    states: Any = facts.get("states", [])
    for state in states:
        say("   ".join([f"at {state['time_s']:.4g} s", *told(state)]))
    if states:
        words = [f"mean of {len(states)} states", *told({name: facts[f"mean_{name}"] for name in METRICS})]
        if "mean_motion_error_mm" in facts:
            mean_mm, high_mm = facts["mean_motion_error_mm"], facts["p95_motion_error_mm"]
            words.append(f"motion wrong by {mean_mm:.3g} mm (95 % below {high_mm:.3g})")
        say("   ".join(words))
