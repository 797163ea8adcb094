"""The samples that a diagnosis works on: the better of the recorded and the smoothed motion, at a working rate.

Accelerations estimated causally from 20 Hz velocities miss several times the sensor's noise, and everything then looks
like an effect; a recording is there as a whole, so it can be smoothed. Arms move slowly against a fast recording's
rate: averaging neighbouring samples first loses nothing of the motion, takes white noise out of the outputs, and leaves
the smoother fewer steps to reach over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from semiparam_ros.core.hyperparameters.window import residual_scale
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples, at_middle
from semiparam_ros.core.signals.rests import typical_step
from semiparam_ros.core.signals.smoothing import acceleration_errors, smoothed, smoothed_again
from semiparam_ros.core.types import Array, Mask
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.outliers import counted_outputs, excluded, working_factor
from semiparam_ros.diagnosis.data.splits import block_sums
from semiparam_ros.diagnosis.regression import Fit, fit_model, refit_weights
from semiparam_ros.diagnosis.residual.noise import inertia_columns
from semiparam_ros.diagnosis.search.candidates import held
from semiparam_ros.diagnosis.search.score import block_grams, summed
from semiparam_ros.effects import Effect, kinds
from semiparam_ros.errors import SemiparamError

BUT_ACCELERATIONS = 'smoothed, accelerations recorded'
FROM_POSITIONS = 'smoothed from positions'
SMOOTHED = {'smoothed with accelerations': (3, 4), 'smoothed more, with accelerations': (3, 6), 'smoothed': (2, 4),
            'smoothed more': (2, 6), FROM_POSITIONS: (1, 4)}
"""How many of positions, velocities and accelerations the smoother uses, and which derivative it takes for white."""
ESTIMATED = ('smoothed', 'smoothed more', FROM_POSITIONS)
OPTIONS = (*SMOOTHED, 'recorded', BUT_ACCELERATIONS)
"""All of them, first those that leave the least noise in the motion."""


class Inputs(NamedTuple):
    """Preparation of a recording: which motion, how many samples each working sample averages, how many of these are
    left out at either end of a smoothed recording, and by how much [s] velocities and accelerations came late."""

    motion: str
    factor: int
    ends: int = DEFAULTS.smoothing_ends
    lags: tuple[float, float] = (0.0, 0.0)

    @property
    def measured_accelerations(self) -> bool:
        """Return whether the accelerations rest on those of the recording."""
        return self.motion not in ESTIMATED

    def prepare(self, samples: Samples) -> Samples:
        """Another recording of the same robot, prepared alike."""
        return _prepared(self, samples)

    def disturbed(self, samples: Samples) -> tuple[Samples, ...]:
        """The prepared recording with the errors of smoothing once more, see :func:`smoothed_again`; none where its
        motion is the recorded one, of which nobody knows the errors."""
        if self.motion not in SMOOTHED:
            return ()
        return smoothed_again(self.working(samples), self.prepare(samples), *SMOOTHED[self.motion])

    def working(self, samples: Samples) -> Samples:
        """The working samples before they are smoothed, velocities and accelerations as early as positions; those that
        were recorded where nothing is smoothed, for between two samples nobody knows them exactly."""
        working = averaged(samples, self.factor)
        if self.motion not in SMOOTHED or not any(self.lags):
            return working
        velocity, acceleration = (_earlier(working.time, values, lag) for values, lag in zip(
            (working.velocity, working.acceleration), self.lags, strict=True))
        return replace(working, velocity=velocity, acceleration=acceleration)

    def mask(self, mask: Mask) -> Mask:
        """A mask over samples (N,) as one over working samples: true where all that it averages are true.

        Leaves out the ends of a smoothed recording: the smoother sees them from one side alone.
        """
        groups = len(mask) // self.factor
        whole = np.asarray(mask[:groups * self.factor].reshape(groups, self.factor).all(axis=1))
        if self.motion != 'recorded':
            whole[:self.ends] = whole[len(whole) - self.ends:] = False
        return whole


@lru_cache(maxsize=len(OPTIONS) + 1)
def _prepared(inputs: Inputs, samples: Samples) -> Samples:
    working = inputs.working(samples)
    if inputs.motion == BUT_ACCELERATIONS:
        return replace(_prepared(inputs._replace(motion='smoothed'), samples), acceleration=working.acceleration)
    made = smoothed(working, *SMOOTHED[inputs.motion]) if inputs.motion in SMOOTHED else working
    return replace(made, whole=True)


def measured_lags(samples: Samples, inputs: Inputs, config: DiagnosisConfig = DEFAULTS) -> tuple[float, float]:
    """[s] by how much recorded velocities, and accelerations, come after what the positions say, as filtered ones do; 0
    where the blocks are not sure of it.

    A late derivative is x'(t - tau) = x'(t) - tau x''(t), so tau is a regression of what it differs by from that of
    smoothed positions on the next derivative, each joint weighed by what it scatters.
    """
    smooth, working = inputs._replace(motion=FROM_POSITIONS).prepare(samples), averaged(samples, inputs.factor)
    jerk = np.gradient(smooth.acceleration, smooth.time, axis=0)
    moves = inputs.mask(np.ones(len(samples), dtype=bool))
    late = [_lag(working.time, recorded, told, next_one, moves, config) if recorded.any() else 0.0
            for recorded, told, next_one in zip(
                (working.velocity, working.acceleration), (smooth.velocity, smooth.acceleration),
                (smooth.acceleration, jerk), strict=True)]
    return late[0], late[1]


def _lag(time: Array, recorded: Array, told: Array, derivative: Array, moves: Mask, config: DiagnosisConfig) -> float:
    if moves.sum() < 2:
        return 0.0
    lag, step, error = 0.0, np.inf, 0.0
    for _ in range(config.newton_steps):
        differs = (told - _earlier(time, recorded, lag))[moves]
        weight = 1.0 / np.maximum(differs.var(axis=0), 1e-300)
        right, left = (block_sums(values @ weight, config.blocks)
                       for values in (differs * derivative[moves], derivative[moves]**2))
        step = float(right.sum() / max(left.sum(), 1e-300))
        error = float(np.sqrt(np.sum((right - step * left) ** 2)) / max(left.sum(), 1e-300))
        lag += step
        if abs(step) < error:
            break
    return lag if abs(lag) > config.sure * error else 0.0


def _earlier(time: Array, values: Array, lag: float) -> Array:
    """Values (N, k) so much [s] earlier."""
    return np.column_stack([np.interp(time + lag, time, each) for each in values.T]) if lag else values


def best_inputs(body: RigidBody, samples: Samples, effects: Sequence[Effect], train_mask: Mask,
                config: DiagnosisConfig = DEFAULTS) -> Inputs:
    """The motion with which the declared model, and what every arm has, predict unseen blocks best (of several that no
    block tells apart the first of OPTIONS), and the factor to the working rate.

    No motion that comes late: late outputs would choose it, and it would hide a part of their delay, or make up one.

    Raises SemiparamError when too few samples are left to work with.
    """
    factor = working_factor(samples, config)
    lags = measured_lags(samples, Inputs(FROM_POSITIONS, factor, config.smoothing_ends), config)
    late_motion = {'recorded': max(lags), BUT_ACCELERATIONS: lags[1]}  # by how much their derivatives are late
    in_time = [name for name in OPTIONS if late_motion.get(name, 0.0) <= _least_lag(samples)]
    possible = in_time if samples.acceleration.any() else ESTIMATED
    options = {name: Inputs(name, factor, config.smoothing_ends, lags) for name in OPTIONS if name in possible}
    common = np.all([inputs.mask(train_mask) for inputs in options.values()], axis=0)
    require_enough(config, common, of=samples)
    outputs = samples.outputs[train_mask]
    scale = residual_scale(outputs - outputs.mean(axis=0), outputs)
    densities: dict[str, Array] = {}
    for name, inputs in options.items():
        prepared = inputs.prepare(samples)
        fit = refit_weights(fit_model(body, prepared, with_usual(body, prepared, effects), common, scale, config,
                                      counted_outputs(body, prepared, config)))
        densities[name] = block_grams(fit).densities(fit.scale, np.ones(body.n_outputs))
    best = max(densities, key=lambda name: float(densities[name].sum()))
    lost = {name: summed(densities[best] - densities[name]) for name in options}
    return options[next(name for name in options if lost[name].total <= lost[name].error)]


def prepared(body: RigidBody, samples: Samples, effects: Sequence[Effect], may_fit: Mask,
             config: DiagnosisConfig = DEFAULTS, inputs: Inputs | None = None,
             clean: Mask | None = None) -> tuple[Inputs, Samples, Mask, Mask]:
    """Return how samples are prepared for a model with these effects, the working samples, which (M,) of
    them may be used, and which of their outputs (M, n) tell something.

    :param may_fit: (N,) those that choose the motion. :param inputs: how to prepare them; chosen unless given.
    :param clean: (N,) those that may be used; all beside no gap and no shock unless given.
    """
    clean = ~excluded(samples, config) if clean is None else clean
    inputs = inputs or best_inputs(body, samples, effects, clean & may_fit, config)
    chosen = inputs.prepare(samples)
    counted = counted_outputs(body, chosen, config)
    return inputs, chosen, inputs.mask(clean) & counted.any(axis=1), counted


def fast_enough(fit: Fit, samples: Samples, inputs: Inputs) -> DiagnosisConfig:
    """The thresholds of a fit, with a higher working rate where this one is too low for the motion.

    What a working sample errs by grows with the fourth power of the time that it averages over: beside
    :func:`averaged`, 29 / 1920 of the fourth difference of the outputs. Where that is as much evidence as effects are
    believed from, it may pass for one.

    :param fit: the declared model on the prepared samples. :param samples: the recording.
    """
    config, fewest = fit.config, -(-len(samples) // fit.config.most_working_samples)
    within = np.lib.stride_tricks.sliding_window_view(fit.train_mask, 5).all(axis=1)
    rigid = fit.body.outputs_of(fit.samples, fit.rigid_part)
    errors = 29.0 / 1920.0 * np.diff(rigid, 4, axis=0)[within] / fit.scale
    too_much = 0.5 * float(np.sum(errors**2)) / float(np.log(config.odds))
    if inputs.factor <= fewest or too_much <= 1.0:
        return config
    fewer = max(min(int(inputs.factor * too_much ** (-1.0 / 8.0)), inputs.factor - 1), fewest)
    return replace(config, working_rate_hz=1e9 / float(np.median(np.diff(samples.stamps))) / (fewer + 0.5))


def of_one_rate(recordings: Sequence[Samples], config: DiagnosisConfig = DEFAULTS) -> list[Samples]:
    """The recordings, those that are faster averaged down to about the rate of the slowest."""
    factors = [working_factor(samples, config) for samples in recordings]
    return [averaged(samples, factor // min(factors)) for samples, factor in zip(recordings, factors, strict=True)]


def with_usual(body: RigidBody, samples: Samples, effects: Sequence[Effect]) -> list[Effect]:
    """The effects beside those of motion alone that all joints have, as friction: without them the noise of a motion
    hardly shows in the outputs."""
    known, nothing = held(effects), np.zeros_like(samples.outputs)
    usual = [kind.from_values(where, kind.searches(body, samples, where, nothing)[0])
             for kind in kinds(body.outputs).values() if kind.group and not kind.calibrations
             for where in kind.places(body) if (kind.kind, where) not in known]
    return [*effects, *usual]


def too_fast(samples: Samples, inputs: Inputs, fit: Fit) -> tuple[list[str], Array]:
    """A sentence where errors of estimated accelerations make most of what the model leaves of an output; empty
    otherwise. And (n,) the share of what it leaves of each that they make.

    :param fit: the model on the prepared samples.
    """
    if inputs.measured_accelerations:
        return [], np.zeros(fit.body.n_outputs)
    config, raw, smoother = fit.config, inputs.working(samples), SMOOTHED[inputs.motion]
    spread = fit.samples.acceleration.std(axis=0)
    left = fit.squares / np.maximum(fit.counts, 1.0)
    power = np.mean(inertia_columns(fit.body, fit.samples, fit.rigid_part)[fit.train_mask] ** 2, axis=0)
    # of a joint at rest they are below rounding, which hides nothing of the others
    errors, *finer = np.nan_to_num(acceleration_errors(raw, *smoother, times=(1, *config.faster)))
    share, *shares = [power @ each**2 / left for each in (errors, *finer)]
    if share.max() < config.most:
        return [], share
    rate = inputs.factor * 1e9 / float(np.median(np.diff(raw.stamps)))
    enough = next((times for times, fewer in zip(config.faster, shares, strict=True)
                   if fewer.max() < config.little), None)
    worst = int((power[share.argmax()] * errors**2).argmax())  # of a joint at rest errors are all that there is
    remedy = f'record at {rate * enough:.0f} Hz, or measure them' if enough else 'measure them'
    return [f'The motion is too fast for {rate:.0f} Hz: accelerations cannot be had better than to '
            f'{100 * errors[worst] / max(spread[worst], 1e-12):.1f} % ({fit.body.joints[worst]}), and that is most of '
            f'what the model leaves. Small effects found here, or small ones not found, say little; {remedy}.'], share


def _least_lag(samples: Samples) -> float:
    """[s] half a sample: what is later than that comes late."""
    return 0.5e-9 * float(np.median(np.diff(samples.stamps)))


def late(inputs: Inputs, samples: Samples, filter_declared: bool = False) -> list[str]:
    """A sentence about velocities, unless their filter is declared, and one about accelerations, that come after the
    positions, as filtered ones do."""
    least, sentences = _least_lag(samples), list[str]()
    remedies = (f'declare velocity_filter{{"time_constant_s": {inputs.lags[0]:.2g}}}',
                'where none are published, raise acceleration.cutoff')
    for order, (name, lag, remedy) in enumerate(
            zip(('velocities', 'accelerations'), inputs.lags, remedies, strict=True), start=1):
        if lag > least and not (order == 1 and filter_declared):
            smooth_but = order == 1 and inputs.motion == BUT_ACCELERATIONS
            used = SMOOTHED.get('smoothed' if smooth_but else inputs.motion, (0,))[0]
            here = ('Here they were taken as much earlier.' if used > order else 'They were not used here.' if used else
                    'Until then a friction or a delay found here may be off.')
            sentences.append(f'The {name} come {1e3 * lag:.1f} ms after the motion of the positions, as a filter makes '
                             f'them: publish them unfiltered, or {remedy}. {here}')
    return sentences


def _usual_step(steps: Array, moved: Array, between: Array) -> float:
    """Time [s] in which a sample follows another: the median of ``steps`` (N,), which is a short one where most arrive
    together; then that in which the joints, by the velocities between (N, k), ``moved`` as far (N, k) in most of the
    way, but no more than the mean step, for positions and velocities may be in different units."""
    forward = steps > 0.0
    weight = np.sum(between**2, axis=1) * forward
    if not weight.any():
        return typical_step(np.append(0.0, np.cumsum(steps)))
    told = np.sum(moved * between, axis=1)[weight > 0.0] / weight[weight > 0.0]
    order = told.argsort()
    way = np.cumsum(weight[weight > 0.0][order])
    by_velocity = float(told[order][np.searchsorted(way, 0.5 * way[-1])])
    return max(float(np.median(steps[forward])), min(by_velocity, float(steps[forward].mean())))


def bursts(samples: Samples, config: DiagnosisConfig = DEFAULTS) -> list[str]:
    """A sentence where many stamps are those of messages that arrived together: a sample a short step after another
    one lies as far from it, by the velocities, as after any other step."""
    steps, velocity = np.diff(samples.time), samples.velocity
    between = 0.5 * (velocity[1:] + velocity[:-1])
    typical = _usual_step(steps, np.diff(samples.position, axis=0), between)
    short = (steps > 0.0) & (steps < config.most * typical)
    if short.sum() < config.least_working_samples:
        return []
    weight = np.sum(between[short] ** 2, axis=1)
    moved = float(np.sum(np.diff(samples.position, axis=0)[short] * between[short]))
    stamped, regular = float(weight @ steps[short]), typical * float(weight.sum())
    if moved - stamped < config.most * (regular - stamped):
        return []
    return [f'The stamps come in bursts: {short.sum()} samples are stamped less than {1e3 * config.most * typical:.1f}'
            f' ms after the one before, though the joints moved on as in {1e3 * typical:.1f} ms. Have the driver stamp '
            'when it measures, not when a message arrives: the accelerations are off, and so is whatever is found.']


def most_samples(rate_hz: float) -> int:
    """Number of samples of this rate that a diagnosis looks at."""
    return DEFAULTS.most_working_samples * max(int(rate_hz / DEFAULTS.working_rate_hz), 1)


def require_enough(config: DiagnosisConfig, *masks: Mask, of: Samples | None = None) -> None:
    """Raise SemiparamError when a mask over working samples leaves too few of them.

    :param of: the recording, whose stamps are told as the reason where they come in bursts.
    """
    fewest = min(int(mask.sum()) for mask in masks)
    if fewest < config.least_working_samples:
        reasons = ''.join(f' {sentence}' for sentence in bursts(of, config)) if of is not None else ''
        raise SemiparamError(f'{fewest} samples of the recording, averaged to at least {config.working_rate_hz:g} Hz, '
                             'are left beside its ends, gaps, shocks, standstill and what is held out; a diagnosis '
                             f'needs at least {config.least_working_samples}.{reasons}')


@lru_cache(maxsize=2)
def averaged(samples: Samples, factor: int) -> Samples:
    """Means of ``factor`` neighbouring samples, for the time in their middle; a remainder at the end is left out.

    Their mean differs from that where a quantity curves, which is taken off. Outputs are products of the motion and
    curve more than it does, so means of both read as a gain.
    """
    if factor == 1:
        return samples
    groups = len(samples) // factor
    stamps = samples.stamps[:groups * factor].reshape(groups, factor)
    middle = stamps[:, 0] + (stamps[:, -1] - stamps[:, 0]) // 2
    length = factor * float(np.median(np.diff(samples.stamps))) * 1e-9

    def mean(values: Array) -> Array:
        return np.asarray(values[:groups * factor].reshape(groups, factor, -1).mean(axis=1))

    def now(values: Array) -> Array:
        return at_middle(mean(values), middle, length, factor)

    return Samples(middle, now(samples.position), now(samples.velocity), now(samples.acceleration),
                   now(samples.outputs), samples.origin, samples.breaks, averaged_s=length,
                   averaged_of=factor * samples.averaged_of, temperature=mean(samples.temperature))
