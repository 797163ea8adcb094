"""One self-contained HTML page of a comparison: no network, no script, light and dark."""

from __future__ import annotations

from typing import NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from semiparam_ros import __version__
from semiparam_ros.report.comparison import plots
from semiparam_ros.report.comparison.experiment import Comparison
from semiparam_ros.report.comparison.figures import VariantFigures
from semiparam_ros.report.comparison.findings import verdict
from semiparam_ros.report.comparison.tables import cells, columns, number
from semiparam_ros.report.svg import inline_svg

WRENCH_CHANNELS = ('force x', 'force y', 'force z', 'torque x', 'torque y', 'torque z')


class Picture(NamedTuple):
    """A figure and the caption that says what to see."""

    title: str
    svg: Markup
    caption: str


def page(comparison: Comparison, train: str, test: str, command: str) -> str:
    """The page's text.

    :param train: name of the first recording. :param test: of the second. :param command: what made it.
    """
    shown = columns(comparison)
    template = _environment().get_template('comparison.html.j2')
    return template.render(
        version=__version__, train=train, test=test, command=command, scenario=comparison.scenario,
        verdict=verdict(comparison.figures, comparison.findings), findings=comparison.findings, columns=shown,
        groups=_groups([column.heading for column in shown]),
        rows={variant: [cells(comparison, column)[variant] for column in shown] for variant in comparison.figures},
        pictures=pictures(comparison), hyperparameters=[_hyperparameters(one) for one in comparison.figures.values()],
        colours=plots.COLOURS)


def pictures(comparison: Comparison) -> list[Picture]:
    """All figures with their captions."""
    figures, scenario = comparison.figures, comparison.scenario
    names = WRENCH_CHANNELS if scenario.settings.outputs == 'wrench' else scenario.settings.joints or tuple(
        f'joint {index + 1}' for index in range(scenario.test.outputs.shape[1]))
    several = f"{_count(len(scenario.subsets), 'subset')} and {_count(len(scenario.seeds), 'feature draw')}"
    return [
        _picture('Error over the horizon, in time', 'courses', plots.courses(figures),
                 f'Relative squared error of predicting the next {scenario.settings.horizon_length} samples, averaged '
                 f'over {several} and smoothed over two seconds. Lower is better. Look at how fast a curve falls in '
                 'the first minute, and where it settles. Dotted lines: 30 s and 60 s.'),
        _picture('Error over the horizon, in steady state', 'boxes', plots.boxes(figures),
                 'The same index after the first 30 s: box from quartile to quartile, line at the median, whiskers '
                 'from the 5th to the 95th percentile. A low box is accurate, a short one dependable.'),
        _picture('Are the uncertainties honest?', 'calibration', plots.calibration(figures),
                 'How many more measurements a band holds than it promises. Zero is honest, below zero the model is '
                 'too sure of itself, above it too cautious; the shaded strip is two points wide on either side.'),
        _picture('Error of each output', 'channels', plots.channels(figures, names),
                 'Mean squared error over the variance of the output: open circles while the model learns, filled '
                 'circles frozen as the first recording left it. The distance between the two is what learning on is '
                 'worth.')]


def _count(number: int, noun: str) -> str:
    return f'{number} {noun}' if number == 1 else f'{number} {noun}s'


def _picture(title: str, name: str, figure: object, caption: str) -> Picture:
    return Picture(title, Markup(inline_svg(figure, name, title)), caption)  # type: ignore[arg-type]


def _groups(headings: list[str]) -> list[tuple[str, int]]:
    """Equal neighbouring headings with their number, for cells that span columns."""
    groups: list[tuple[str, int]] = []
    for heading in headings:
        if groups and groups[-1][0] == heading:
            groups[-1] = (heading, groups[-1][1] + 1)
        else:
            groups.append((heading, 1))
    return groups


def _hyperparameters(one: VariantFigures) -> dict[str, str]:
    """Those of the first seed, as text; a dash for what the class does not have."""
    first = one.hyperparameters[0]
    drift = f'{100 * first.drift_share:.0f} %' if first.drift_share > 0 else '–'
    return {'variant': one.variant, 'gamma': _or_dash(first.gamma), 'rho': _or_dash(first.rho),
            'tau': ', '.join(number(value) for value in first.tau) or '–', 'sigma': number(first.sigma),
            'scale': ', '.join(number(value) for value in first.output_scale), 'drift': drift,
            'seconds': number(one.fit_seconds, 2)}


def _or_dash(value: float) -> str:
    return number(value) if value else '–'


def _environment() -> Environment:
    return Environment(loader=PackageLoader('semiparam_ros', 'report/templates'), undefined=StrictUndefined,
                       autoescape=select_autoescape(default=True, default_for_string=True), trim_blocks=True,
                       lstrip_blocks=True)
