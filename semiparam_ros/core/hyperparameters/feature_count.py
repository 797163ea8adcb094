"""Number of random features that the initial window asks for: the fewest whose evidence is as good
as that of many.

Features of one seed are taken from the first on, so that fewer are a part of more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from semiparam_ros.core.hyperparameters.marginal_likelihood import Window
from semiparam_ros.core.hyperparameters.maximisation import EvidenceMaximum, maximise_from

MOST = 500
"""Features that fewer are compared with."""

FEWER = (50, 100, 200, 300, 400)

ENOUGH, FEW_NAT = 0.001, 2.0
"""Evidence [nat] that may be lost for each measured value, a fifth of a per cent of squared error; and in any case."""


def fewer_features(window: Window) -> Iterator[Window]:
    """The same window with fewer and fewer of its features left out."""
    for count in FEWER:
        if 2 * len(window.spectrum) > count:
            yield replace(window, spectrum=window.spectrum[:count // 2])


def fewest_features(window: Window, many: EvidenceMaximum, noise: str, drifting: bool,
                    method: str) -> tuple[Window, EvidenceMaximum]:
    """The window with as few features as are enough, and the maximum of its evidence.

    :param many: the maximum with all of them, from where the others' are searched.
    """
    least = many.value - max(ENOUGH * window.outputs.size, FEW_NAT)
    for few in fewer_features(window):
        found = maximise_from(few, many.at, noise, drifting, method)
        if found.value >= least:
            return few, found
    return window, many
