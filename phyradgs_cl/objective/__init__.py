"""The objective (paper, Eq. 4): image terms, total variation, density and shape terms."""

from phyradgs_cl.objective.image_terms import ImageLoss, image_loss
from phyradgs_cl.objective.parameter_terms import ParameterTerms, parameter_loss
from phyradgs_cl.objective.total_variation import TotalVariation, total_variation

__all__ = ["ImageLoss", "ParameterTerms", "TotalVariation", "image_loss", "parameter_loss", "total_variation"]
