"""The objective (paper, Eq. 4): image terms, total variation, density and shape terms; TV maps of voxel methods."""

from phyradgs_cl.objective.dct_prox import DctProx
from phyradgs_cl.objective.image_terms import ImageLoss, image_loss
from phyradgs_cl.objective.nonlocal_step import NonlocalStep
from phyradgs_cl.objective.parameter_terms import ParameterTerms, parameter_loss
from phyradgs_cl.objective.total_variation import TotalVariation, total_variation
from phyradgs_cl.objective.tv_descent import TvDescent
from phyradgs_cl.objective.tv_prox import TvProx

__all__ = [
    "DctProx",
    "ImageLoss",
    "NonlocalStep",
    "ParameterTerms",
    "TotalVariation",
    "TvDescent",
    "TvProx",
    "image_loss",
    "parameter_loss",
    "total_variation",
]
