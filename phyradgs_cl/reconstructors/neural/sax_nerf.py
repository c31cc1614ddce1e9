"""SAX-NeRF: a neural field with attention along line segments, fitted to scattered rays and windows of rays.

Y. Cai, J. Wang, A. Yuille, Z. Zhou, A. Wang, "Structure-Aware Sparse-View X-ray 3D Reconstruction", CVPR 2024.
"""

from functools import partial

from phyradgs_cl.neural import LineOptions
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.neural.naf import NAF_PUBLISHED
from phyradgs_cl.reconstructors.neural.run import reconstruct_neural

# The released configuration Lineformer/chest_50: that of NAF, with 256 samples for 128 voxels
SAX_PUBLISHED = LineOptions(**{**vars(NAF_PUBLISHED), "samples": 256})
# Windows do not change the expected gradient of a squared error, and of few pixels per step they leave it to noise
SAX_PRESETS = {"default": LineOptions(iterations=50, windows=0), "published": SAX_PUBLISHED}

METHOD = Method(partial(reconstruct_neural, method="sax-nerf"), SAX_PRESETS)
