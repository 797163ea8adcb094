"""The paper's model classes as one table (Romeres et al. 2016, sections III and IV)."""

from __future__ import annotations

from typing import NamedTuple


class Variant(NamedTuple):
    """Which terms a model has and how its hyperparameters are chosen.

    ``pi``, the coefficients of the coupled columns: ``learnt`` online with a Gaussian prior, ``fixed`` after the
    initial window, or ``absent``. ``selection``: marginal likelihood (ml) or a validation set (vs).
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
