"""PhyRadGS: exact radiative splats that know the gantry's motion (the paper's method).

M×N micro-views per frame; ``options.motion`` static is the paper's "w/o ST".
"""

from functools import partial

from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.splats.method import reconstruct_splats
from phyradgs_cl.reconstructors.splats.options import PRESETS

METHOD = Method(partial(reconstruct_splats, method="phyradgs"), PRESETS, is_shared=True, takes_initial=True)
