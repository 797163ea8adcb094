"""The paper's experiment on any pair of recordings: scenario, runs, figures (Romeres et al. 2016, section V)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from semiparam_ros.bags.loading import LoadedBag, description_in, require_same_robot
from semiparam_ros.core.estimator import Estimator, EstimatorState
from semiparam_ros.core.hyperparameters.estimation import Hyperparameters
from semiparam_ros.core.initial_window import gathered_from
from semiparam_ros.core.model import AUTO
from semiparam_ros.core.samples import Samples, variance
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.core.variants import AVERAGED, VARIANTS
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.evaluation import TRANSIENT_S, normalised_errors
from semiparam_ros.experiments.initial_window import Estimation, fitted_settings
from semiparam_ros.experiments.parallel import run_all
from semiparam_ros.online.model_jobs import known_of
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_estimator, hyperparameter_values, model_options

EARLY_S = 60.0
LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99)
BAND = 0.95

PARAMETRIC = 'P'
PAIRS = (('NP-ML', 'NP-VS'), ('SP2-ML', 'SP2-VS'))
BEST = ('SP-ML', 'SPK-ML')
TIE = 1.05
"""Figures within 5 % of each other count as equal: feature draws differ by as much."""
CLOSE = 1.5
"""Models are close in steady state when the worst index is at most this many times the best."""
NAMES = {'eps_force': 'force', 'eps_torque': 'torque', 'eps_effort': 'effort'}


@dataclass(frozen=True)
class ComparisonScenario:
    """One comparison.

    :param settings: with the joints by name.
    :param train: the initial window, then what is learnt online. :param test: what is predicted, in ``subsets``.
    :param subsets: (first, last + 1) rows of ``test``; each starts from the model that ``train`` left.
    """

    settings: Settings
    train: Samples
    test: Samples
    robot_description: str | None
    subsets: tuple[tuple[int, int], ...]
    variants: tuple[str, ...]
    seeds: tuple[int, ...]
    estimation: Estimation = field(default_factory=Estimation)

    def draws(self) -> list[tuple[str, int]]:
        """Variant and feature seed of every model that is learnt."""
        return [(variant, seed) for variant in self.variants
                for seed in (self.seeds[:1] if variant == PARAMETRIC else self.seeds)]  # it draws no features


def scenario_from(settings: Settings, train: LoadedBag, test: LoadedBag, *, subsets: int = 5,
                  subset_samples: int | None = None, train_samples: int | None = None,
                  test_from: int = 0, variants: Sequence[str] = tuple(VARIANTS),
                  seeds: Sequence[int] = (0, 1, 2), estimation: Estimation | None = None) -> ComparisonScenario:
    """Check that the two recordings fit each other and are long enough.

    The paper's models have a bare rigid body, the paper's priors, independent frequencies and no wandering offset:
    with ``forgetting: auto`` they forget nothing and have none here. With ``features.count: auto`` they have as many
    features as it chooses from.

    :param subset_samples: length of each part of ``test``; by default all of it is divided.
    :param train_samples: how much of ``train`` to use; by default all. :param test_from: first row of ``test`` to use.
    """
    require_same_robot(settings, [train, test])
    settings = replace(settings, forgetting=1.0) if settings.forgetting == AUTO else settings
    settings = replace(settings, features_count=model_options(settings).most_features, priors='paper',
                       joint_friction=False, features_frequencies='independent', joints=train.joints)
    if train_samples is not None and train_samples < 1:
        raise SemiparamError(f'{train_samples} samples of the first recording were asked for; expected at least 1.')
    learnt = train.samples[:train_samples]
    if gathered_from(learnt, settings.initial_samples).end >= len(learnt):
        raise SemiparamError(f'the first recording has {len(learnt)} samples to learn from; expected more than the '
                             f'{settings.initial_samples} of the initial window (parameter initial.samples), and those '
                             'of a robot that moves, one of each 4 ms.')
    if not seeds:
        raise SemiparamError('the comparison has no feature seed; expected at least one.')
    split = _split(len(test.samples), test_from, subsets, subset_samples, settings.horizon_length)
    if not variance(test.samples.outputs[test_from:split[-1][1]]).any():
        raise SemiparamError('every output of the second recording is constant; expected outputs that vary, for errors '
                             'are measured against their variance.')
    return ComparisonScenario(settings, learnt, test.samples,
                              description_in([train, test]), split,
                              tuple(variants), tuple(seeds), estimation or Estimation())


def _split(total: int, begin: int, subsets: int, samples: int | None, horizon: int) -> tuple[tuple[int, int], ...]:
    if subsets < 1:
        raise SemiparamError(f'{subsets} subsets were asked for; expected at least 1.')
    if not 0 <= begin < total:
        raise SemiparamError(f'the subsets would start at sample {begin} of the {total} of the second recording.')
    available = total - begin
    length = available // subsets if samples is None else samples
    if length <= horizon:
        raise SemiparamError(f'each of {subsets} subsets of the second recording ({available} samples) has {length} '
                             f'samples; expected more than the horizon of {horizon}.')
    if length * subsets > available:
        raise SemiparamError(f'{subsets} subsets of {length} samples are more than the {available} of the second '
                             'recording.')
    return tuple((start, start + length) for start in range(begin, begin + length * subsets, length))


class Trace(NamedTuple):
    """Trace of N predictions and of K origins' horizon errors [N, N m]; times [s] from the start."""

    errors: Array  # (N, n) predicted minus measured
    outputs: Array  # (N, n)
    std: Array  # (N, n) predictive
    log_density: Array  # (N,) [nat]
    horizon_time: Array  # (K,)
    eps: Array  # (K, n)


class TrainedModel(NamedTuple):
    """State and settings, with its variant and its seed, that let a model go on from where the first recording left it.
    """

    settings: Settings
    state: EstimatorState


class Learnt(NamedTuple):
    """A model, its hyperparameters, and how learning the first recording went."""

    model: TrainedModel
    hyperparameters: Hyperparameters
    fit_seconds: float
    trace: Trace


class SubsetRun(NamedTuple):
    """Traces of a learnt model on one subset of the second recording."""

    adaptive: Trace  # predict, then learn
    frozen: Trace  # predict only


def learn(scenario: ComparisonScenario, variant: str, seed: int) -> Learnt:
    """Hyperparameters from the initial window, then the rest of the first recording, sample by sample."""
    gathered = gathered_from(scenario.train, scenario.settings.initial_samples)
    initial = gathered.end
    chosen = replace(scenario.settings, variant=variant, features_seed=seed)
    start = time.perf_counter()
    if variant == AVERAGED:  # parameters hold the hyperparameters of one variant alone
        settings, estimator = _averaged_after(scenario, chosen, scenario.train[:initial])
        hyperparameters, seconds = estimator.model.hyperparameters, time.perf_counter() - start
    else:
        settings, hyperparameters = fitted_settings(chosen, scenario.train[gathered.indices],
                                                    scenario.robot_description, scenario.estimation)
        seconds = time.perf_counter() - start
        estimator = build_estimator(settings, scenario.robot_description, scenario.train.origin)
        run_through(estimator, scenario.train[:initial], learning=True)
    estimator.clear_horizons()
    trace = run_through(estimator, scenario.train[initial:], learning=True)
    return Learnt(TrainedModel(settings, estimator.state()), hyperparameters, seconds, trace)


def _averaged_after(scenario: ComparisonScenario, settings: Settings, initial: Samples) -> tuple[Settings, Estimator]:
    """The averaged variants after the initial window, and settings with the hyperparameters of the first of them."""
    estimator = build_estimator(replace(settings, hyperparameters_sigma=()), scenario.robot_description,
                                scenario.train.origin)
    run_through(estimator, initial, learning=True)
    if not estimator.ready:
        estimator.finish_window()
    known = known_of(estimator)
    assert known is not None
    return settings.changed(hyperparameter_values(*known[:3])), estimator


def follow(scenario: ComparisonScenario, model: TrainedModel, subset: int) -> SubsetRun:
    """One subset from the trained model, with and without learning it."""
    first, last = scenario.subsets[subset]
    samples = scenario.test[first:last]
    traces = []
    for learning in (True, False):
        estimator = build_estimator(model.settings, scenario.robot_description, samples.origin)
        estimator.restore(model.state)
        estimator.begin_recording(samples.origin, int(samples.stamps[0]))  # which may be hours later
        traces.append(run_through(estimator, samples, learning))
    return SubsetRun(*traces)


def run_through(estimator: Estimator, samples: Samples, learning: bool) -> Trace:
    """Predict, then perhaps learn, every sample."""
    mean, std = np.empty_like(samples.outputs), np.empty_like(samples.outputs)
    density = np.empty(len(samples))
    horizons = []
    for row, sample in enumerate(samples):
        prediction = estimator.step(sample, learning)
        mean[row], std[row], density[row] = prediction.mean, prediction.std, prediction.log_density
        if prediction.horizon is not None:
            horizons.append(prediction.horizon)
    origins = np.array([horizon.origin for horizon in horizons], dtype=np.int64)
    eps = np.array([horizon.eps for horizon in horizons]).reshape(-1, samples.outputs.shape[1])
    return Trace(mean - samples.outputs, samples.outputs, std, density, 1e-9 * (origins - samples.stamps[0]), eps)


class Spread(NamedTuple):
    """A figure over feature seeds; ``std`` is None for a single seed."""

    mean: float
    std: float | None
    values: tuple[float, ...]


class ModeFigures(NamedTuple):
    """Errors and bands of one way of predicting (predict, then learn; or frozen), over all subsets."""

    nmse: Spread  # mean over channels of squared error over variance
    nmse_by_channel: tuple[float | None, ...]  # mean over seeds; None for a constant channel
    coverage: Spread  # part of the measurements within the 95 % band
    coverage_by_level: tuple[float, ...]  # mean over seeds, for LEVELS
    log_density: Spread  # mean per sample [nat]


class IndexFigures(NamedTuple):
    """One horizon index: its course, averaged over subsets, and what the paper reads off it."""

    time: Array  # (K,) [s]
    series: Array  # (seeds, K)
    first_30_s: Spread | None  # None where nothing falls into the phase
    first_60_s: Spread | None
    steady_state: Spread | None  # after the first 30 s
    spread: Spread | None  # interquartile range after the first 30 s


@dataclass(frozen=True)
class VariantFigures:
    """Figures of one variant. ``indices``: 'eps_force' and 'eps_torque', or 'eps_effort'."""

    variant: str
    seeds: tuple[int, ...]
    first: ModeFigures  # the rest of the first recording, predicted and learnt
    adaptive: ModeFigures
    frozen: ModeFigures
    indices: dict[str, IndexFigures]
    hyperparameters: tuple[Hyperparameters, ...]
    fit_seconds: float


def figures_of(outputs: str, followed: Sequence[tuple[Learnt, Sequence[SubsetRun]]]) -> VariantFigures:
    """Gather the models of one variant, each with its runs on all subsets. :param outputs: 'wrench' or 'effort'."""
    learnt = [one for one, _ in followed]
    seeds = tuple(one.model.settings.features_seed for one in learnt)
    adaptive = [[run.adaptive for run in runs] for _, runs in followed]
    frozen = [[run.frozen for run in runs] for _, runs in followed]
    indices = {name: index_figures(adaptive, channels) for name, channels in channel_groups(outputs).items()}
    first = mode_figures([[one.trace] for one in learnt])
    return VariantFigures(learnt[0].model.settings.variant, seeds, first, mode_figures(adaptive), mode_figures(frozen),
                          indices, tuple(one.hyperparameters for one in learnt),
                          float(np.mean([one.fit_seconds for one in learnt])))


def channel_groups(outputs: str) -> dict[str, slice]:
    """Horizon indices and the outputs that each is the mean over."""
    if outputs == 'wrench':
        return {'eps_force': slice(0, 3), 'eps_torque': slice(3, 6)}
    return {'eps_effort': slice(None)}


def mode_figures(seeds: Sequence[Sequence[Trace]]) -> ModeFigures:
    """Errors and bands over the traces of all subsets, which ``seeds`` lists for each seed."""
    pooled = [Trace(*(np.concatenate(parts) for parts in zip(*traces, strict=True))) for traces in seeds]
    ratios = np.array([normalised_errors(trace.errors, trace.outputs)[0] for trace in pooled], dtype=float)
    covered = np.array([[_coverage(trace, level) for level in LEVELS] for trace in pooled])
    known = ~np.isnan(ratios).any(axis=0)
    channels = tuple(float(value) if ok else None for value, ok in zip(ratios.mean(axis=0), known, strict=True))
    return ModeFigures(_spread(ratios[:, known].mean(axis=1)), channels, _spread(covered[:, LEVELS.index(BAND)]),
                       tuple(covered.mean(axis=0).tolist()),
                       _spread(np.array([trace.log_density.mean() for trace in pooled])))


def index_figures(seeds: Sequence[Sequence[Trace]], channels: slice) -> IndexFigures:
    """The index of one group of outputs from the traces of all subsets, for each seed."""
    length = min(len(trace.eps) for traces in seeds for trace in traces)
    time = seeds[0][0].horizon_time[:length]
    series = np.array([np.mean([trace.eps[:length, channels].mean(axis=1) for trace in traces], axis=0)
                       for traces in seeds])
    late = time >= TRANSIENT_S
    return IndexFigures(time, series, _phase(series, ~late), _phase(series, time < EARLY_S), _phase(series, late),
                        _phase(series, late, interquartile_range))


def interquartile_range(values: Array) -> float:
    """Distance of the quartiles."""
    lower, upper = np.percentile(values, [25, 75])
    return float(upper - lower)


def _phase(series: Array, within: Mask, measure: Callable[[Array], float] = np.mean) -> Spread | None:
    if not within.any():
        return None
    return _spread(np.array([measure(row[within]) for row in series]))


def _spread(values: Array) -> Spread:
    std = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Spread(float(np.mean(values)), std, tuple(float(value) for value in values))


def _coverage(trace: Trace, level: float) -> float:
    return float(np.mean(np.abs(trace.errors) <= norm.ppf(0.5 + level / 2.0) * trace.std))


Judgement = tuple[bool, str]
"""Verdict whether a statement holds by one index, and the figures that say so."""


class PaperFinding(NamedTuple):
    """A statement of the paper, whether it holds here (None: cannot be said), and the figures that say so."""

    name: str
    statement: str
    holds: bool | None
    evidence: str


def findings_of(figures: Mapping[str, VariantFigures]) -> tuple[PaperFinding, ...]:
    """Findings of the paper whose variants were compared."""
    found = []
    if PARAMETRIC in figures and len(figures) > 1:
        found.append(parametric_is_worst(figures))
    if any(ml in figures and vs in figures for ml, vs in PAIRS):
        found.append(likelihood_beats_validation(figures))
    others = set(figures) - set(BEST) - {PARAMETRIC}
    if set(BEST) <= set(figures) and others:
        found += [semi_parametric_is_best(figures, 'average'), semi_parametric_is_best(figures, 'spread')]
    if len(set(figures) - {PARAMETRIC}) > 1:
        found.append(others_are_close(figures))
    return tuple(found)


def parametric_is_worst(figures: Mapping[str, VariantFigures]) -> PaperFinding:
    """Finding that P has the largest index after the first 30 s."""
    def judge(values: dict[str, float]) -> Iterator[Judgement]:
        worst, next_worst = sorted(values, key=lambda variant: values[variant], reverse=True)[:2]
        if worst != PARAMETRIC:
            next_worst = worst
        yield worst == PARAMETRIC, (f'P {values[PARAMETRIC]:.3g}, next worst {next_worst} '
                                    f'{values[next_worst]:.3g}')
    return _finding('parametric_is_worst', 'The rigid body alone (P) is the poorest model.',
                    figures, 'steady_state', judge)


def likelihood_beats_validation(figures: Mapping[str, VariantFigures]) -> PaperFinding:
    """Finding that ML variants have a smaller index than their VS twins in the first 60 s."""
    def judge(values: dict[str, float]) -> Iterator[Judgement]:
        for ml, vs in PAIRS:
            if ml in values and vs in values:
                yield values[ml] < values[vs], f'{ml} {values[ml]:.3g}, {vs} {values[vs]:.3g}'
    return _finding('likelihood_beats_validation',
                    'Marginal likelihood gives better models than a validation set in the first 60 s.',
                    figures, 'first_60_s', judge)


def semi_parametric_is_best(figures: Mapping[str, VariantFigures], what: str) -> PaperFinding:
    """Finding that SP-ML and SPK-ML have the least index, or spread of it, after the first 30 s."""
    field, word = ('steady_state', 'on average') if what == 'average' else ('spread', 'in spread')

    def judge(values: dict[str, float]) -> Iterator[Judgement]:
        others = {variant: value for variant, value in values.items() if variant not in BEST}
        rival = min(others, key=lambda variant: others[variant])
        yield (all(values[variant] <= TIE * others[rival] for variant in BEST),
               ', '.join(f'{variant} {values[variant]:.3g}' for variant in BEST)
               + f', best of the others {rival} {others[rival]:.3g}')
    return _finding(f'semi_parametric_is_best_{what}',
                    f'SP-ML and SPK-ML are the best {word} (ties within 5 %).', figures, field, judge)


def others_are_close(figures: Mapping[str, VariantFigures]) -> PaperFinding:
    """Finding that all but P are within a factor of 1.5 after the first 30 s."""
    def judge(values: dict[str, float]) -> Iterator[Judgement]:
        others = [variant for variant in values if variant != PARAMETRIC]
        least, most = (pick(others, key=lambda variant: values[variant]) for pick in (min, max))
        yield (values[most] <= CLOSE * values[least],
               f'{least} {values[least]:.3g} to {most} {values[most]:.3g}, a factor of '
               f'{values[most] / values[least]:.2f}')
    return _finding('others_are_close',
                    f'All but P are close in steady state (within a factor of {CLOSE:g}).',
                    figures, 'steady_state', judge)


def _finding(name: str, statement: str, figures: Mapping[str, VariantFigures], field: str,
             judge: Callable[[dict[str, float]], Iterator[Judgement]]) -> PaperFinding:
    """Finding from what ``judge`` says of each index, given variant -> mean of ``field`` over seeds.

    An index whose recording is too short for the phase is not judged.
    """
    verdicts: list[bool] = []
    texts: list[str] = []
    for index in next(iter(figures.values())).indices:
        spreads = {variant: getattr(one.indices[index], field) for variant, one in figures.items()}
        values = {variant: spread.mean for variant, spread in spreads.items() if spread is not None}
        for holds, text in judge(values) if values else ():
            verdicts.append(holds)
            texts.append(f'{NAMES[index]}: {text}')
    evidence = '; '.join(texts) + '.' if texts else 'The second recording is too short to tell.'
    return PaperFinding(name, statement, all(verdicts) if verdicts else None, evidence)


def verdict(figures: Mapping[str, VariantFigures], findings: tuple[PaperFinding, ...]) -> str:
    """Sentences on which variant to use here, and how many of the paper's findings hold."""
    best = min(figures.values(), key=lambda one: one.adaptive.nmse.mean)
    frozen = min(figures.values(), key=lambda one: one.frozen.nmse.mean)
    sentences = [f'{best.variant} predicts best while it learns (normalised error {_with_spread(best.adaptive.nmse)})']
    if frozen.variant == best.variant:
        sentences[0] += f' and also without learning the second recording ({_with_spread(frozen.frozen.nmse)}).'
    else:
        sentences[0] += (f'; without learning the second recording {frozen.variant} does '
                         f'({_with_spread(frozen.frozen.nmse)}).')
    judged = [finding for finding in findings if finding.holds is not None]
    if judged:
        held = sum(bool(finding.holds) for finding in judged)
        sentences.append(f"{held} of {len(judged)} findings of the paper hold on these recordings.")
    sentences.append(_bands(best))
    return ' '.join(sentences)


def _bands(best: VariantFigures) -> str:
    share = best.adaptive.coverage.mean
    honest = 'honest' if 0.93 <= share <= 0.97 else 'too narrow' if share < 0.93 else 'too wide'
    return f'Its 95 % bands hold {100 * share:.1f} % of the measurements: {honest}.'


def _with_spread(figure: Spread) -> str:
    return f'{figure.mean:.3g}' if figure.std is None else f'{figure.mean:.3g} ± {figure.std:.1g}'


@dataclass(frozen=True)
class Comparison:
    """Comparison as a report shows it."""

    scenario: ComparisonScenario
    figures: dict[str, VariantFigures]
    findings: tuple[PaperFinding, ...]


def steps(scenario: ComparisonScenario) -> int:
    """Number of pieces of work, for a progress bar."""
    return len(scenario.draws()) * (1 + len(scenario.subsets))


def compare(scenario: ComparisonScenario, done: Callable[[], None] = lambda: None) -> Comparison:
    """Run the scenario, as many pieces at a time as the surrounding :func:`parallel.workers` has."""
    learnt = run_all(learn, [(scenario, *draw) for draw in scenario.draws()], done)
    subsets = range(len(scenario.subsets))
    runs = iter(run_all(follow, [(scenario, one.model, subset) for one in learnt for subset in subsets], done))
    followed = [(one, list(islice(runs, len(subsets)))) for one in learnt]
    figures = {variant: figures_of(scenario.settings.outputs, [
        each for each in followed if each[0].model.settings.variant == variant]) for variant in scenario.variants}
    return Comparison(scenario, figures, findings_of(figures))
