"""The comparison page in a real browser: no error in its console, nothing fetched, light and dark."""

import functools
from dataclasses import replace

import numpy as np

from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.variants import VARIANTS
from semiparam_ros.experiments.comparison import (
    Comparison,
    ComparisonScenario,
    Learnt,
    SubsetRun,
    Trace,
    TrainedModel,
    figures_of,
    findings_of,
)
from semiparam_ros.report.comparison_page import page
from semiparam_ros.settings import Settings
from support.browser import check_that_it_stands_alone, is_dark

SEEDS = (3, 4)


def trace(rng, level, steps=800, outputs=6):
    """A plausible run: errors and indices around a level."""
    measured = rng.normal(size=(steps, outputs))
    eps = level * np.exp(0.3 * rng.normal(size=(steps, outputs)))
    return Trace(np.sqrt(level) * rng.normal(size=(steps, outputs)), measured, np.full((steps, outputs), level**0.5),
                 rng.normal(size=steps), 0.1 * np.arange(steps), eps)


def comparison(outputs='wrench', seeds=SEEDS):
    """All variants on invented runs of two subsets."""
    rng = np.random.default_rng(0)
    n = 6 if outputs == 'wrench' else 3
    settings = Settings(outputs=outputs, joints=() if outputs == 'wrench' else ('<one>', '$two_$', 'three'))
    samples = Samples(np.arange(1200), *[np.zeros((1200, 4))] * 3, np.zeros((1200, n)), 0)
    scenario = ComparisonScenario(settings, samples, samples, None, ((0, 600), (600, 1200)),
                                  tuple(VARIANTS), tuple(seeds))
    figures = {}
    for level, variant in enumerate(VARIANTS, start=1):
        own = [trace(rng, 0.01 * level, outputs=n) for _ in seeds]
        learnt = [Learnt(TrainedModel(replace(settings, variant=variant, features_seed=seed), {}),
                         Hyperparameters(0.1, 1.0, (1.0, 2.0, 3.0), 0.1, (1.0,) * n, None, 0.3, 20.0), 1.5, run)
                  for seed, run in zip(seeds, own, strict=True)]
        followed = [[SubsetRun(trace(rng, 0.01 * level, outputs=n), trace(rng, 0.02, outputs=n)) for _ in (0, 1)]
                    for _ in seeds]
        figures[variant] = figures_of(outputs, list(zip(learnt, followed, strict=True)))
    return Comparison(scenario, figures, findings_of(figures))


NAMES = ('a<b.mcap', 'c&d.mcap', "semiparam compare 'a<b.mcap' 'c&d.mcap'")


@functools.cache
def wrench_page():
    return page(comparison(), *NAMES)


def test_the_page_opens_without_an_error_in_the_console(browse):
    document, console = browse(wrench_page(), '--dump-dom')
    assert console == []
    assert document.count('<svg') == 4
    assert all(f'</span>{variant}</th>' in document for variant in VARIANTS)


def test_an_error_in_the_console_would_be_noticed(browse):
    broken = wrench_page().replace('</body>', '<script>console.error("broken"); nothing()</script></body>')
    _, console = browse(broken, '--dump-dom')
    assert len(console) == 2


def test_the_page_is_dark_as_the_reader_is(browse, tmp_path):
    """That it is light as he is follows for the page of a diagnosis, which has the same style."""
    assert is_dark(browse, wrench_page(), tmp_path / 'shot.png', '--force-dark-mode')


def test_it_stands_alone():
    check_that_it_stands_alone(wrench_page())


def test_names_are_text_not_markup():
    assert '<h1>a&lt;b.mcap' in wrench_page()
    assert 'c&amp;d.mcap' in wrench_page()


def test_the_same_figures_give_the_same_page():
    assert page(comparison(), *NAMES) == wrench_page()


def test_efforts_have_one_index_and_the_joints_names_and_one_draw_has_no_spread():
    text = page(comparison('effort', seeds=(0,)), 'a', 'b', 'c')
    assert 'Efforts' in text
    assert 'Torques' not in text
    assert '&lt;one&gt;' in text and '$two_$' in text
    assert 'class="spread"' in wrench_page()
    assert 'class="spread"' not in text


def test_it_tells_where_the_initial_window_ended():
    """It was said to be the first samples also of a robot that stood still at first, and others learnt after it."""
    one = comparison()
    position = np.zeros((1200, 4))
    position[100:] = np.sin(0.1 * np.arange(1100))[:, None]
    train = replace(one.scenario.train, stamps=10**7 * np.arange(1200), position=position)
    text = page(replace(one, scenario=replace(one.scenario, train=train)), *NAMES)
    assert 'From 1000 of the first 1105 samples of ' in text
    assert 'from 1000 of the first 1105 samples, the other 95 learnt online.' in text
