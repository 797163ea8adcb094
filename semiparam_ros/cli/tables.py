"""Tables of results for the terminal, 80 columns wide."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

HEADINGS = {'eps_force': 'eps^F', 'eps_torque': 'eps^T', 'eps_effort': 'eps'}
PHASES = {'first_30_s': '< 30 s', 'steady_state': 'steady'}


def print_scores(console: Console, results: Mapping[str, Mapping[str, Any]]) -> None:
    """One row for each variant: nMSE, the horizon indices at first and in steady state, and the update time."""
    indices = [name for name in HEADINGS if any(result.get(name) for result in results.values())]
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, 0))
    table.add_column('\nvariant', no_wrap=True)
    phases = [f'{HEADINGS[name]}\n{phase}' for name in indices for phase in PHASES.values()]
    for heading in ['\nnMSE', *phases, 'update\n[ms]', '\np99', '\nsamples']:
        table.add_column(heading, justify='right', no_wrap=True)
    for variant, result in results.items():
        values = [result[name][phase] for name in indices for phase in PHASES]
        times = result['update_ms'] or {'median': None, 'p99': None}
        table.add_row(variant, figure(result['nmse_mean']), *map(figure, values), figure(times['median']),
                      figure(times['p99']), str(result['samples']))
    console.print(table)


def figure(value: float | None) -> str:
    """Three significant digits, or a dash where there is no number."""
    if value is None:
        return '-'
    return f'{value:.3g}' if value >= 1e-3 or value == 0.0 else f'{value:.1e}'
