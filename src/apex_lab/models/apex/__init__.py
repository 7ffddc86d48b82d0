"""APEX (Wu et al. 2021). Where each numbered equation of the paper is:

Eq. 1 likelihood.py · Eq. 2, 13, 14 model.py (`Apex.forward`) · Eq. 3, 4 objective.py (`kl_terms`) · Eq. 5, 6 objects.py
(`Propagation`, priors) and objective.py (`discovery_priors`) · Eq. 7-12 masks.py · Eq. 15 objects.py (`Propagation`) ·
Eq. 16-18 objects.py (`Discovery`, `context_probability`) · Eq. 19, 20 objective.py · Eq. 21 objective.py
(`mask_entropy`) · Eq. 22 the weighted sum that the learner makes of `Scene.terms`.
"""

from apex_lab.models.apex.background import Background
from apex_lab.models.apex.encoder import ApexEncoder
from apex_lab.models.apex.glimpses import FeatureGlimpses, ImageGlimpses
from apex_lab.models.apex.likelihood import GaussianLikelihood, MixtureLikelihood
from apex_lab.models.apex.masks import ApexNormalisation, ScalorNormalisation
from apex_lab.models.apex.model import Apex
from apex_lab.models.apex.objective import DiscoveryPrior

__all__ = [
    "Apex",
    "ApexEncoder",
    "ApexNormalisation",
    "Background",
    "DiscoveryPrior",
    "FeatureGlimpses",
    "GaussianLikelihood",
    "ImageGlimpses",
    "MixtureLikelihood",
    "ScalorNormalisation",
]
