"""NAF: attenuation as a hash encoding and a small network, fitted to rays.

R. Zha, Y. Zhang, H. Li, "NAF: Neural Attenuation Fields for Sparse-View CBCT Reconstruction", MICCAI 2022.
"""

from functools import partial

from phyradgs_cl.neural import NeuralOptions
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.neural.run import reconstruct_neural

# Paper, section 3, and the released configuration chest_50: 192 samples for 128 voxels per side
NAF_PUBLISHED = NeuralOptions(
    iterations=1500,
    rays=1024,
    jitter="sample",
    positive_only=True,
    voxel_points=1,
    levels=16,
    base_resolution=16,
    table_log2=19,
    density_bound=1.0,
    first_share=0.5,
    rate=1e-3,
    rate_factor=0.1,
    rate_step=1500,
)
NAF_PRESETS = {"default": NeuralOptions(), "published": NAF_PUBLISHED}

METHOD = Method(partial(reconstruct_neural, method="naf"), NAF_PRESETS)
