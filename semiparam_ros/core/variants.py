"""The paper's model classes as one table (Romeres et al. 2016, sections III and IV)."""

from __future__ import annotations

from typing import NamedTuple

from semiparam_ros.errors import SemiparamError


class Variant(NamedTuple):
    """Terms of a model, and how its hyperparameters are chosen.

    ``pi``, the coefficients of the rigid body and the offset: ``learnt`` online with a Gaussian prior, ``fixed`` after
    the initial window, or ``absent``. Those of effects are learnt online in every variant.
    ``selection``: marginal likelihood (ml) or a validation set (vs).
    """

    features: bool
    pi: str
    selection: str


VARIANTS: dict[str, Variant] = {
    'P': Variant(features=False, pi='learnt', selection='ml'),
    'NP-ML': Variant(features=True, pi='absent', selection='ml'),
    'SP-ML': Variant(features=True, pi='fixed', selection='ml'),
    'SP2-ML': Variant(features=True, pi='fixed', selection='ml'),
    'SPK-ML': Variant(features=True, pi='learnt', selection='ml'),
    'NP-VS': Variant(features=True, pi='absent', selection='vs'),
    'SP2-VS': Variant(features=True, pi='fixed', selection='vs'),
}

AVERAGED = 'auto'
"""Several variants side by side, averaged by their running evidence (core.estimator)."""
MEMBERS = ('SPK-ML', 'P', 'NP-VS')
"""Those that are averaged; what is asked of one model is that of the first."""
CHOICES = (*VARIANTS, AVERAGED)
PRIORS = ('physical', 'paper')
"""``physical``: theta is near the robot description, as far as the robot is large; features explain no more than the
rigid body leaves, and may not be there at all. ``paper``: theta has one variance about zero, and nothing else is held.
"""
FREQUENCIES = ('orthogonal', 'independent')
"""How the frequencies of features are drawn; ``independent`` is the paper's."""


def single(name: str) -> str:
    """The variant itself, or the first of those averaged."""
    return MEMBERS[0] if name == AVERAGED else name


def has_both(name: str) -> bool:
    """Tell whether it has a rigid body and features."""
    variant = VARIANTS[single(name)]
    return variant.features and variant.pi != 'absent'


def variant_named(name: str) -> Variant:
    """The variant of that name, or a SemiparamError that lists them."""
    if name not in CHOICES:
        raise SemiparamError(f"variant '{name}' is unknown; expected one of {', '.join(CHOICES)}.")
    return VARIANTS[single(name)]
