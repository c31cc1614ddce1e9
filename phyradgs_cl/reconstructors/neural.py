"""The neural methods ``naf`` and ``sax-nerf``: a field fitted to a scan's rays. A run imports PyTorch when it begins.

NAF: R. Zha, Y. Zhang, H. Li, "NAF: Neural Attenuation Fields for Sparse-View CBCT Reconstruction", MICCAI 2022: a hash
encoding and a small network. SAX-NeRF: Y. Cai, J. Wang, A. Yuille, Z. Zhou, A. Wang, "Structure-Aware Sparse-View X-ray 3D
Reconstruction", CVPR 2024: attention along line segments, and windows of rays in addition to scattered ones."""

import time
from functools import partial
from importlib.metadata import version

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.neural import LineOptions, NeuralOptions, require_torch
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.loop import Loop
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, ignore_progress, option_facts
from phyradgs_cl.reconstructors.splats.start import internal_scale
from phyradgs_cl.runtime import Runtime


def reconstruct_neural(
    scan: Scan, options: NeuralOptions, rt: Runtime, *, method: str, seed: int = 0,
    report: ProgressReport = ignore_progress, resume: State | None = None,
) -> Reconstruction:
    """Returns the volume of a neural field fitted to a scan. ``seed`` sets the random parameters, frames, pixels, samples.

    ``rt`` computes the FDK volume that sets the unit of attenuation; PyTorch does the rest. ``resume`` continues an
    interrupted run of the same scan and options from its state. Raises InputError where PyTorch is not installed, and
    DeviceError for a device that PyTorch does not have."""
    require_torch(f"--method {method}")
    from phyradgs_cl.neural.field import first_field, torch_device
    from phyradgs_cl.neural.trainer import Trainer

    started = time.perf_counter()
    device = torch_device(options.torch_device)
    scale = internal_scale(static_fdk(rt, scan), scan.grid)
    field = first_field(options, max(scan.grid.shape), seed)
    trainer = Trainer(scan, options, field, device, scale.density_per_mm, seed)
    loop = Loop(trainer, rt.ranks, report, started)
    loop.run(resume)
    facts: dict[str, object] = {
        "method": method, "options": option_facts(options), "seed": seed, "unit_length_mm": scale.length_mm,
        "unit_density_per_mm": scale.density_per_mm, "detector_model": trainer.model,
        "parameters": trainer.parameters, "levels": options.levels_for(max(scan.grid.shape)),
        "samples": trainer.samples, "times": trainer.times, "iterations": trainer.iteration,
        "torch_device": str(device), "torch_version": version("torch"), "seconds": loop.seconds,
        "interrupted_at": loop.interrupted_at,
    }  # fmt: skip
    state = loop.state_if_interrupted()
    return Reconstruction(*trainer.present_volume(), record=loop.record, facts=facts, state=state)


# NAF's paper, section 3, and its released configuration chest_50: 192 samples per ray for 128 voxels per side.
NAF_PUBLISHED = NeuralOptions(
    iterations=1500, rays=1024, jitter="sample", positive_only=True, voxel_points=1, levels=16,
    base_resolution=16, table_log2=19, density_bound=1.0, first_share=0.5, rate=1e-3, rate_factor=0.1,
    rate_step=1500,
)
NAF = Method(partial(reconstruct_neural, method="naf"), {"default": NeuralOptions(), "published": NAF_PUBLISHED})


# SAX-NeRF's released configuration Lineformer/chest_50 is NAF's with 256 samples per ray for 128 voxels per side.
SAX_PUBLISHED = LineOptions(**{**vars(NAF_PUBLISHED), "samples": 256})
# No windows of rays by default: windows keep the expected gradient of a squared error, but make the gradient noisier.
SAX_PRESETS = {"default": LineOptions(iterations=50, windows=0), "published": SAX_PUBLISHED}

SAX_NERF = Method(partial(reconstruct_neural, method="sax-nerf"), SAX_PRESETS)
