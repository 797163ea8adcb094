"""The tables and pictures of docs/benchmarks.md and docs/measurements.md, from the JSON files beside this script.

    python docs/figures/render.py

A file that a command wrote with ``--json`` has a function here that makes its table. A file with
``typed_from`` was copied from that page of the log; it holds its table as it is. Tables stand
between two marks that name the file.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

FOLDER = Path(__file__).resolve().parent
PAGES = [FOLDER.parent / 'benchmarks.md', FOLDER.parent / 'measurements.md']
LEARNING, FROZEN, EARLY, PLAIN = '#2f6fd0', '#1a9a6c', '#a9d8c5', '#dd8a00'
Document = dict[str, Any]


class Table(NamedTuple):
    """Headings and cells, as text."""

    columns: Sequence[str]
    rows: Iterable[Sequence[str]]

    def __str__(self) -> str:
        lines = [self.columns, ['---'] * len(self.columns), *self.rows]
        return ''.join(f'| {" | ".join(cells)} |\n' for cells in lines)


def percent(share: float, digits: int = 0) -> str:
    """Of a share."""
    return f'{100.0 * share:.{digits}f} %'


def document(name: str) -> Document:
    """One of the files."""
    return dict(json.loads((FOLDER / f'{name}.json').read_text(encoding='utf-8')))


def variants(found: Document) -> Table:
    """Error while learning the second recording, and the share within the bands of the default."""
    chosen = ('P', 'SP-ML', 'SPK-ML', 'auto')
    return Table(('Recording', *chosen, '95 % bands hold (SPK-ML)'), [
        (pair, *(f'{runs[name]["learning"]["nmse"]:.4f}' for name in chosen),
         percent(runs["SPK-ML"]["learning"]["band"], 1)) for pair, runs in _by_pair(found).items()])


def variants_in_short(found: Document) -> Table:
    """Those of fewer variants, with simulated arms in one row."""
    chosen = ('P', 'SPK-ML', 'auto')

    def cells(several: Sequence[dict[str, Document]]) -> Sequence[str]:
        errors = (median(runs[name]['learning']['nmse'] for runs in several) for name in chosen)
        bands = median(runs['SPK-ML']['learning']['band'] for runs in several)
        return *(f'{error:.4f}' for error in errors), percent(bands, 1)

    return Table(('Recording', 'Rigid body (P)', 'Default (SPK-ML)', '`auto`', '95 % bands hold (default)'),
                 _in_short(_by_pair(found), cells))


def _in_short(pairs: dict[str, Any], cells: Callable[[Sequence[Any]], Sequence[str]]) -> list[Sequence[str]]:
    """Rows of pairs, and one of what simulated arms have: their medians."""
    simulated = [runs for name, runs in pairs.items() if '(simulated)' in name]
    rows: list[Sequence[str]] = [(name, *cells([runs])) for name, runs in pairs.items() if '(simulated)' not in name]
    return [*rows, (f'{len(simulated)} simulated arms, medians', *cells(simulated))]


def frozen_variants(found: Document) -> Table:
    """Error on the second recording without learning it."""
    chosen = ('P', 'SP-ML', 'SP2-ML', 'SPK-ML', 'auto')
    return Table(('A to B', *chosen), [
        (pair, *(f'{runs[name]["frozen"]["nmse"]:.4f}' for name in chosen))
        for pair, runs in _by_pair(found).items()])


def _by_pair(found: Document) -> dict[str, dict[str, Document]]:
    pairs: dict[str, dict[str, Document]] = {}
    for run in found['runs']:
        pairs.setdefault(run['pair'], {})[run['variant']] = run
    return pairs


def other_motion(found: Document) -> Table:
    """After ten seconds of A and after all of it, beside the plain model."""
    rows = []
    for pair, (early, whole) in _by_seconds(found).items():
        frozen, ahead = whole['frozen'], whole.get('feedforward')
        errors = (whole['plain'], early['frozen']['nmse'], frozen['nmse'])
        rows.append((pair, *(f'{error:.4f}' for error in errors),
                     f'{frozen["nmse"] / whole["plain"]:.2f}', percent(frozen['band'], 1),
                     f'{whole["learning"]["nmse"]:.4f}',
                     percent(ahead['valid']) if ahead else 'all cut'))
    return Table(('A to B', 'By hand', 'Frozen after 10 s', 'Frozen', 'Over by hand', 'Bands hold',
                  'Learning B', 'States valid'), rows)


def other_motion_in_short(found: Document) -> Table:
    """Fewer columns, with simulated arms in one row."""
    def cells(several: Sequence[tuple[Document, Document]]) -> Sequence[str]:
        each = [(whole['plain'], early['frozen']['nmse'], whole['frozen']['nmse'],
                 whole['frozen']['nmse'] / whole['plain']) for early, whole in several]
        plain, early, frozen, ratio = map(median, zip(*each, strict=True))
        bands = median(whole['frozen']['band'] for _, whole in several)
        return f'{plain:.4f}', f'{early:.4f}', f'{frozen:.4f}', f'{ratio:.2f}', percent(bands, 1)

    return Table(('A to B', 'By hand', 'After 10 s of A', 'After all of A', 'Over by hand', '95 % bands hold'),
                 _in_short(_by_seconds(found), cells))


def _by_seconds(found: Document) -> dict[str, tuple[Document, Document]]:
    """Each pair's run after ten seconds and after the whole motion."""
    whole = {run['pair']: run for run in found['runs'] if run['seconds'] is None}
    early = {run['pair']: run for run in found['runs'] if run['seconds'] is not None}
    return {pair: (early[pair], run) for pair, run in whole.items()}


def bench(found: Document) -> Table:
    """Median cost of a sample by the number of features."""
    names = ('SPK', 'Potter', 'dense')
    return Table(('Features', 'A sample [us]', 'Textbook update (Potter) of the features alone [us]',
                  'Textbook recursion on all unknowns [us]'), [
        (f'D = {size["features"]}', *(f'{size["microseconds"][name]:.0f}' for name in names))
        for size in found['sizes']])


def effects_cost(found: Document) -> Table:
    """Cost of the default by what is declared: median and range, and over the cost of none in the same round."""
    runs = [run for run in found['runs'] if run['variant'] == 'SPK-ML']
    arms = list(dict.fromkeys(run['arm'] for run in runs))
    cells = {(run['declared'], run['arm']): run for run in runs}
    rows = []
    for name in dict.fromkeys(run['declared'] for run in runs):
        row = [name]
        for arm in arms:
            run, none = cells[name, arm], cells['none', arm]
            ratio = median(one / other for one, other in zip(run['sample_us'], none['sample_us'], strict=True))
            row += [_median_and_range(run['sample_us']), f'{ratio:.2f}', _median_and_range(run['desired_us']),
                    _median_and_range(run['learner_us'])]
        rows.append(row)
    return Table(('Declared', *(f'{arm.split(" (")[0]}: {what}' for arm in arms
                                for what in ('sample [us]', 'over none', 'desired state [us]', 'in the node [us]'))),
                 rows)


def _median_and_range(values: Sequence[float]) -> str:
    return f'{median(values):.0f} ({min(values):.0f} to {max(values):.0f})'


def many_joints(found: Document) -> Table:
    """Cost by the number of joints."""
    return Table(('Joints', 'Base parameters', 'P [us]', 'SPK-ML [us]',
                  'Hyperparameters of SPK-ML [s]'), [
        (str(run['joints']), str(run['columns']), f'{run["sample_us"]["P"]:.0f}',
         f'{run["sample_us"]["SPK-ML"]:.0f}', f'{run["window_s"]["SPK-ML"]:.1f}')
        for run in found['runs']])


def measured_arms(found: Document) -> Table:
    """Held-out errors of diagnoses beside the fit by hand, and how many of each kind were found."""
    return Table(('Recording', 'Before', 'After', 'By hand', 'After, over by hand', 'Found'), [
        (run['case'], f'{run["before"]:.4f}', f'{run["after"]:.4f}', f'{run["plain"]:.4f}',
         f'{run["after"] / run["plain"]:.2f}', _kinds(run['found'])) for run in found['runs']])


def measured_arms_in_short(found: Document) -> Table:
    """Those that are judged on another recording, or another part of it."""
    return Table(('Recording', 'Before', 'After', 'By hand'), [
        (run['case'], *(f'{run[name]:.4f}' for name in ('before', 'after', 'plain')))
        for run in found['runs'] if 'blocks' not in run['case']])


def _kinds(found: Sequence[str]) -> str:
    """Kinds of effects, with how many there are of each."""
    counts = Counter(effect.partition('@')[0] for effect in found)
    named = (f'`{kind}`' if count == 1 else f'{count} `{kind}`' for kind, count in counts.items())
    return ', '.join(named) or 'nothing'


def scoreboard(found: Document) -> Table:
    """Hidden causes, from the rows that two calls wrote for each kind of recording."""
    rows = []
    for run in found['runs']:
        hidden = [row for row in run['rows'] if row['kind'] != 'nothing']
        clean = [row for row in run['rows'] if row['kind'] == 'nothing']
        starts = [abs(row['start_off_samples']) <= 2.0 for row in hidden
                  if row['start_off_samples'] is not None]
        values = [abs(off) <= 2.0 for row in hidden for off in row['deviations_off']]
        exact = [row['verdict'] == 'effect_found' and row['found'] == [row['kind']]
                 for row in hidden]
        alarms = [row['verdict'] != 'nothing_missing' for row in clean]
        rows.append((f'{run["outputs"]}, {run["accelerations"]}',
                     *(f'{sum(each)} of {len(each)}' for each in (exact, alarms, starts, values))))
    return Table(('Outputs, accelerations', 'Right kind, nothing beside it', 'False alarms',
                  'Starts within two samples', 'Values within two deviations'), rows)


def put_down(found: Document) -> Table:
    """Causes that are there for a part of a recording."""
    spans = {'until': 'Until 41 s', 'between': '22 to 45 s', 'short': '30 to 41 s',
             'since': 'Since 45 s'}
    return Table(('Cause', 'Outputs', *spans.values()), [
        (run['cause'], run['outputs'],
         *(f'{run["right"][span]} of {run["recordings"]}' for span in spans))
        for run in found['runs']])


def tracking(found: Document) -> Table:
    """Tracking errors of three seeds."""
    rows = []
    for arm in dict.fromkeys(run['arm'] for run in found['runs']):
        runs = [run for run in found['runs'] if run['arm'] == arm]
        errors = ([run[name] for run in runs] for name in ('none', 'description', 'learnt'))
        spans = [f'{min(values):.3g} to {max(values):.3g}' for values in errors]
        ratio = [f'{run["learnt"] / run["description"]:.2f}' for run in runs]
        rows.append((arm, *spans, ', '.join(ratio)))
    return Table(('Arm', 'No feedforward', 'Description', 'Learnt', 'Learnt over description'),
                 rows)


def exported_arms(found: Document) -> Table:
    """Errors of exported descriptions."""
    names = ('description', 'exported', 'links changed')
    return Table(('Arm', 'Description', 'Exported', 'Links changed'), [
        (run['arm'], *(run[name].replace('%', ' %') for name in names)) for run in found['runs']])


def changes(found: Document) -> Table:
    """Changes of the robot: noticed, named, and the error back at its floor."""
    rows, runs = [], found['runs']
    for robot, change in dict.fromkeys((run['robot'], run['change']) for run in runs):
        own = [run for run in runs if (run['robot'], run['change']) == (robot, change)]

        def total(name: str, own: Sequence[Document] = own) -> int:
            return sum(run[name] for run in own)

        def every(name: str, own: Sequence[Document] = own) -> list[float]:
            return [value for run in own for value in run[name]]

        count = total('changes')
        told, back, errors = every('delays'), every('back_s'), every('mass_errors')
        shares = [f'{total(name)} of {count}' if count else '' for name in ('noticed', 'named', 'back')]
        mass = f'{percent(median(errors), 1)}, {percent(max(errors))}' if errors else ''
        rows.append((robot, change, shares[0], f'{median(told):.2g}' if told else '', shares[1], mass,
                     shares[2], f'{median(back):.2g}' if back else '', str(total('false')),
                     str(total('retracted'))))
    return Table(('Robot', 'Change', 'Noticed', 'Told after [s]', 'Named', 'Mass error: median, largest',
                  'Back', 'After [s]', 'False', 'Taken back'), rows)


def ordinary_work_in_short(found: Document) -> Table:
    """Changes of all robots in one row each."""
    whole = changes({'runs': [{**run, 'robot': 'all'} for run in found['runs']]})
    kept = [whole.columns.index(name) for name in ('Change', 'Noticed', 'Told after [s]', 'Named', 'Back', 'False')]
    return Table([whole.columns[place] for place in kept], [[row[place] for place in kept] for row in whole.rows])


def carried_load(found: Document) -> Table:
    """Tracking errors while a load comes and goes: medians over the seeds."""
    rows = []
    for arm, mode in dict.fromkeys((run['arm'], run['mode']) for run in found['runs']):
        runs = [run for run in found['runs'] if (run['arm'], run['mode']) == (arm, mode)]
        cells = [
            ', '.join(
                f'{median(run["after"][change][part] / run["before"] for run in runs):.2g}'
                for part in range(3)
            )
            for change in range(3)
        ]
        before = f'{median(run["before"] for run in runs):.2g}'
        rows.append((arm, f'`{mode}`' if mode != 'description' else mode, before, *cells))
    return Table(
        ('Arm', '`diagnosis.auto`', 'Before [mrad]', 'Picked up', 'Put down', 'Picked up again'),
        rows,
    )


MADE: dict[str, tuple[str, Callable[[Document], Table]]] = {
    **{f'{name}_in_short': (name, make) for name, make in (
        ('variants', variants_in_short), ('other_motion', other_motion_in_short),
        ('measured_arms', measured_arms_in_short), ('ordinary_work', ordinary_work_in_short))},
    'variants': ('variants', variants), 'frozen_variants': ('variants', frozen_variants),
    'mujoco_arms': ('mujoco_arms', measured_arms), 'ordinary_work': ('ordinary_work', changes),
    'other_changes': ('other_changes', changes), 'measured_loads': ('measured_loads', changes),
    **{make.__name__: (make.__name__, make) for make in
       (other_motion, bench, effects_cost, many_joints, measured_arms, scoreboard, put_down, tracking,
        exported_arms, changes, carried_load)}}
"""The file and the function of each table that a command's JSON gives."""


def sources() -> Table:
    """Each file, how it came about, and the command."""
    rows = []
    for path in sorted(FOLDER.glob('*.json')):
        found = document(path.stem)
        source = found.get('typed_from')
        origin = f'typed from [{source[4:14]}]({source})' if source else 'written by the command'
        rows.append((f'`{path.name}`', origin))
    return Table(('File', 'Figures'), rows)


def table(name: str) -> str:
    """One table as Markdown."""
    if name == 'sources':
        return str(sources())
    source, make = MADE.get(name, (name, None))
    found = document(source)
    if make is None or 'typed_from' in found:
        return str(Table(found['columns'], found['rows']))
    return str(make(found))


def with_tables(page: str) -> str:
    """The page with each table as its file has it."""
    return re.sub(r'(?<=<!-- table )(\w+)(: begin -->\n).*?(?=<!-- table \1: end -->)',
                  lambda mark: f'{mark[1]}{mark[2]}{table(mark[1])}', page, flags=re.DOTALL)


def draw_other_motion(picture: Path) -> None:
    """Errors on another motion, one row for each robot."""
    from matplotlib.figure import Figure

    found = list(reversed(_by_seconds(document('other_motion')).items()))
    names, runs = zip(*found, strict=True)
    series = {'by hand': (PLAIN, 's', [whole['plain'] for _, whole in runs]),
              'after 10 s of A': (EARLY, 'o', [early['frozen']['nmse'] for early, _ in runs]),
              'after all of A': (FROZEN, 'o', [whole['frozen']['nmse'] for _, whole in runs]),
              'while learning B': (LEARNING, 'o', [whole['learning']['nmse'] for _, whole in runs])}
    figure = Figure(figsize=(7.0, 5.2), layout='constrained')
    panel = figure.subplots()
    for row, values in enumerate(zip(*(values for _, _, values in series.values()), strict=True)):
        panel.plot([min(values), max(values)], [row, row], color='#d5dbe1', linewidth=1.0, zorder=0)
    for label, (colour, marker, values) in series.items():
        panel.scatter(values, range(len(found)), color=colour, marker=marker, s=36, label=label)
    panel.set(xscale='log', xlabel='error on B: mean square over variance',
              yticks=range(len(names)), yticklabels=names)
    panel.legend(ncols=4, fontsize='small', loc='lower center', bbox_to_anchor=(0.45, 1.0),
                 frameon=False)
    panel.grid(axis='x', alpha=0.3)
    panel.spines[['top', 'right']].set_visible(False)
    figure.savefig(picture, dpi=120)


def main() -> None:
    """Write the tables into the pages, and the picture."""
    for page in PAGES:
        page.write_text(with_tables(page.read_text(encoding='utf-8')), encoding='utf-8')
    draw_other_motion(FOLDER.parent / 'images' / 'other_motion.png')


if __name__ == '__main__':
    main()
