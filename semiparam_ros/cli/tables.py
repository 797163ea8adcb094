"""Tables of results for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

HEADINGS = {'eps_force': 'eps^F', 'eps_torque': 'eps^T', 'eps_effort': 'eps'}


def print_scores(console: Console, results: Mapping[str, Mapping[str, Any]]) -> None:
    """One row for each variant: nMSE, the horizon indices at first and in steady state, and the update time."""
    indices = [name for name in HEADINGS if any(result.get(name) for result in results.values())]
    table = Table()
    table.add_column('variant')
    for heading in ['nMSE', *(f'{HEADINGS[name]}\n{phase}' for name in indices for phase in ('first 30 s', 'steady')),
                    'update [ms]\nmedian', '\np99', 'samples']:
        table.add_column(heading, justify='right')
    for variant, result in results.items():
        phases = [result[name][phase] for name in indices for phase in ('first_30_s', 'steady_state')]
        times = result['update_ms'] or {'median': None, 'p99': None}
        table.add_row(variant, figure(result['nmse_mean']), *map(figure, phases), figure(times['median']),
                      figure(times['p99']), str(result['samples']))
    console.print(table)


def figure(value: float | None) -> str:
    """Three significant digits, or a dash where there is no number."""
    return '-' if value is None else f'{value:.3g}'
