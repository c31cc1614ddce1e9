"""The objective (paper, Eq. 4): image terms, total variation, density and shape terms; TV maps of voxel methods."""

from phyradgs_cl.objective.dct_prox import DctProx
from phyradgs_cl.objective.nonlocal_step import NonlocalStep
from phyradgs_cl.objective.terms import (
    ImageLoss,
    ParameterTerms,
    TotalVariation,
    image_loss,
    parameter_loss,
    total_variation,
)
from phyradgs_cl.objective.tv import TvDescent, TvProx

__all__ = [
    "DctProx", "ImageLoss", "NonlocalStep", "ParameterTerms", "TotalVariation", "TvDescent", "TvProx",
    "image_loss", "parameter_loss", "total_variation",
]
