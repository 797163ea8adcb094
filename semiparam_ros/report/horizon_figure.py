"""Plots of the horizon indices over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semiparam_ros.atomic_write import replacing
from semiparam_ros.errors import SemiparamError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from semiparam_ros.experiments.evaluation import VariantScores

LABELS = {'eps_force': r'$\varepsilon^F$', 'eps_torque': r'$\varepsilon^T$', 'eps_effort': r'$\varepsilon$'}


def plot_indices(
    path: Path, scores: Mapping[str, VariantScores], events: Sequence[tuple[float, str]] = ()
) -> None:
    """One panel for each index, one line for each variant, logarithmic; the format is that of the file's suffix.

    :param events: times [s] since the start of the recording, and what happened then.
    """
    from matplotlib.figure import Figure

    names = [name for name in next(iter(scores.values())).index_names if name in LABELS]
    figure = Figure(figsize=(9.0, 2.6 * len(names) + 0.6), layout='constrained')
    panels = np.atleast_1d(figure.subplots(len(names), 1, sharex=True))
    for index, (name, panel) in enumerate(zip(names, panels, strict=True)):
        for order, (variant, score) in enumerate(scores.items()):
            times, values = score.index_series()
            # The first variant, which the others are compared with, lies on top.
            panel.plot(times, values[:, index], linewidth=0.8, label=variant, zorder=3.0 - 0.1 * order)
        panel.set(yscale='log', ylabel=LABELS[name])
        panel.grid(alpha=0.3)
        for seconds, _ in events:
            panel.axvline(seconds, color='black', linewidth=0.8, linestyle=':')
    for seconds, what in events:
        panels[-1].text(seconds, 0.02, f' {what}', rotation=90, fontsize='small', va='bottom', ha='right',
                        transform=panels[-1].get_xaxis_transform(), parse_math=False)
    panels[-1].set_xlabel('time [s]')
    panels[0].legend(ncols=len(scores), fontsize='small')
    save_figure(path, figure)


def save_figure(path: Path, figure: Figure) -> None:
    """Write the whole picture or nothing. Raises SemiparamError for an unknown suffix or an unwritable place."""
    suffix = picture_format(path)
    with replacing(path) as stream:
        figure.savefig(stream, dpi=120, format=suffix)


def picture_format(path: Path) -> str:
    """The format that a file's suffix stands for. Raises SemiparamError for one that matplotlib does not write."""
    from matplotlib.backend_bases import FigureCanvasBase

    suffix, known = path.suffix.removeprefix('.').lower(), sorted(FigureCanvasBase.get_supported_filetypes())
    if suffix not in known:
        raise SemiparamError(f"a plot cannot be written as '{path.name}': expected a suffix of {', '.join(known)}.")
    return suffix
