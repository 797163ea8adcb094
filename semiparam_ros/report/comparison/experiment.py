"""The whole comparison: all models learnt, all subsets followed, figures and findings drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from semiparam_ros.report.comparison.figures import VariantFigures, figures_of
from semiparam_ros.report.comparison.findings import Finding, findings_of
from semiparam_ros.report.comparison.parallel import run_all
from semiparam_ros.report.comparison.runs import follow, learn
from semiparam_ros.report.comparison.scenario import Scenario


@dataclass(frozen=True)
class Comparison:
    """Everything a report shows."""

    scenario: Scenario
    figures: dict[str, VariantFigures]
    findings: tuple[Finding, ...]


def steps(scenario: Scenario) -> int:
    """How many pieces of work there are, for a progress bar."""
    return len(scenario.draws()) * (1 + len(scenario.subsets))


def compare(scenario: Scenario, done: Callable[[], None] = lambda: None) -> Comparison:
    """Run the scenario, as many pieces at a time as the surrounding :func:`parallel.workers` has."""
    learnt = run_all(learn, [(scenario, *draw) for draw in scenario.draws()], done)
    pieces = [(scenario, one.model, subset) for one in learnt for subset in range(len(scenario.subsets))]
    followed = run_all(follow, pieces, done)
    figures = {variant: figures_of(scenario.settings.outputs, [one for one in learnt if one.model.variant == variant],
                                   [one for one in followed if one.variant == variant])
               for variant in scenario.variants}
    return Comparison(scenario, figures, findings_of(figures))
