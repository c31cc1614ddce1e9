"""The objective of splatting (paper, Eq. 4): image loss, total variation, mean density. Also the priors of voxel methods."""

from phyradgs_cl.objective.dct_prox import DctProx
from phyradgs_cl.objective.ridge import RidgeStep, learned_ridge
from phyradgs_cl.objective.terms import ImageLoss, TotalVariation
from phyradgs_cl.objective.tv import TvDescent, TvProx

__all__ = ["DctProx", "ImageLoss", "RidgeStep", "TotalVariation", "TvDescent", "TvProx", "learned_ridge"]
