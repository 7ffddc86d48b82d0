"""APEX (Wu et al. 2021). Where each equation of the paper is, by the paper's own numbers (`grep -rn "Eq\\. 7"`):

Eq. 1   likelihood.py  `MixtureLikelihood`     likelihood of an image
Eq. 2   loop.py        `roll_out`              posterior of a video, frame by frame
Eq. 3   objective.py   `kl_terms`              prior of a video, frame by frame
Eq. 4   background.py  `prior`                 prior of a frame: the background's factor (the others: Eq. 5 and Eq. 6)
Eq. 5   objects.py     `Propagation`           prior of a propagated object
Eq. 6   objective.py   `DiscoveryPrior`        prior of a discovered object
Eq. 7   masks.py       `logits`                mask logits alpha
Eq. 8   masks.py       `foreground`            foreground mask
Eq. 9   masks.py       `_competition`          logits of the competition between objects, alpha_hat
Eq. 10  masks.py       `compose`               objects' shares of the foreground, m_hat
Eq. 11  masks.py       `compose`               masks of the objects
Eq. 12  masks.py       `compose`               mask of the background
Eq. 13  loop.py        `roll_out`              Eq. 2 again
Eq. 14  loop.py        `roll_out`              posterior of a frame: propagated, discovered, background
Eq. 15  objects.py     `Propagation`           posterior of a propagated object
Eq. 16  objects.py     `Discovery`             posterior of a discovered object
Eq. 17  loop.py        `roll_out`              presence of a discovered object
Eq. 18  objects.py     `context_probability`   its p_context
Eq. 19  model.py       `_explain`              ELBO: the likelihood term
Eq. 20  objective.py   `kl_terms`              ELBO: the KL terms
Eq. 21  objective.py   `mask_entropy`          mask entropy loss
Eq. 22  model.py       `_explain`              full objective: `WeightUpdate.objective` (conf/recipe/apex)
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
