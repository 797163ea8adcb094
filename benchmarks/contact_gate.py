"""The contact gate: false alarms in free motion, pushes found, and a load that is a contact for some seconds only.

    python benchmarks/contact_gate.py                                  a simulated iCub arm with its sensor
    python benchmarks/contact_gate.py --urdf ur3.urdf                  a simulated arm of joint efforts with friction
    python benchmarks/contact_gate.py id1.mcap id2.mcap --params ur3.yaml    recordings of free motion, in this order

The robot moves, but stands still for 20 s after a quarter and after half of the time (its own sample held, with the
noise of the recording's differences). From 60 to 80 % of the time it carries a weight. Each seed is run twice, with the
gate on and learning in the loop as in the node: as it is; and with pushes at the last link, of 5 to 80 N (uniform in
their logarithm), 0.3 to 2 s long, in random directions, added to the outputs by the Jacobian.

A push *stands out* by the largest change of an output over the usual peak of its innovations at that time: the median
of the largest ones in half a second, over the half minute about the push in the run without pushes, motion or rest as
during the push. A closure during a push, or 0.2 s after, finds it. One later than 1 s after a push, and later than
the timeout of the gate and 1 s after the weight came or went, is a false alarm.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.signals.differentiation import CausalDifferentiator
from semiparam_ros.core.types import Array
from semiparam_ros.online.contact_gate import ContactGate
from semiparam_ros.online.usual_peaks import BLOCK_S, SPEEDS
from semiparam_ros.settings import Settings, load_params
from semiparam_ros.settings.build import build_estimator
from semiparam_ros.settings.robot_description import moving_joints, robot_description
from semiparam_ros.simulation import EffectRequest, Scenario, simulate
from semiparam_ros.simulation.arm import Arm

REST_S = 20.0
FORCES_N, PUSH_S = (5.0, 80.0), (0.3, 2.0)
LOAD_AT = (0.6, 0.8)
RESTS_AT = (0.25, 0.5)
ABOUT_S = 15.0
FOUND_AFTER_S, CALM_AFTER_S = 0.2, 1.0
STANDS_OUT = 5.0
CLASSES = (0.0, 1.0, 2.0, 3.0, STANDS_OUT, 10.0, np.inf)


class Recording(NamedTuple):
    """Free motion of a robot and how to touch it."""

    settings: Settings
    samples: list[Sample]
    arm: Arm
    noise_std: Array | None = None
    """(n,) of the outputs, where it is known."""


class Push(NamedTuple):
    """One contact: times [s] from the first sample, force [N], and how far it stands out."""

    start: float
    end: float
    force: float
    size: float


class Run(NamedTuple):
    """(N,) times [s], (N, n) innovations, (N,) whether the gate was closed."""

    times: Array
    innovations: Array
    closed: Array

    def closures_outside(self, spans: list[tuple[float, float]]) -> list[float]:
        """Times [s] at which it closed, those within one of the spans left out."""
        times = self.times[np.flatnonzero(np.diff(self.closed.astype(int), prepend=0) == 1)]
        return [float(time) for time in times if not any(start <= time <= stop for start, stop in spans)]


def simulated(urdf: str | None, seconds: float, rate_hz: float, seed: int) -> Recording:
    """A mixture of circles, Fourier motion and reaching; friction in every joint where efforts are measured."""
    effects: tuple[EffectRequest, ...] = ()
    if urdf is not None:
        joints = Arm.from_urdf(urdf, moving_joints(Settings(outputs='effort'), urdf), 'effort').joints
        effects = tuple(EffectRequest(kind, joint, 1.0, 0.0) for joint in joints
                        for kind in ('coulomb_friction', 'viscous_friction'))
    found = simulate(Scenario(motion='mixed', samples=round(seconds * rate_hz), rate_hz=rate_hz, seed=seed,
                              urdf=urdf, outputs='wrench' if urdf is None else 'effort', effects=effects,
                              baseline='bundled' if urdf is None else 'none', accelerations=False))
    settings = Settings(robot_description=found.urdf, joints=found.joint_names, outputs=found.outputs_kind,
                        sensor_frame=found.frame_id, wrench_convention='reaction')
    differentiator = CausalDifferentiator(len(found.joint_names), settings.acceleration_cutoff)
    samples = [Sample(int(stamp), position, velocity, differentiator.update(int(stamp), velocity), outputs)
               for stamp, position, velocity, outputs in zip(found.stamps, found.position, found.velocity,
                                                             found.outputs, strict=True)]
    return Recording(settings, samples, arm_of(settings, found.urdf), found.noise_std)


def recorded(paths: list[str], params: str) -> Recording:
    """Recordings, the later ones moved in time so that they follow the ones before."""
    settings, samples = load_params(params), list[Sample]()
    urdf = None
    for path in paths:
        bag = load_samples(path, settings)
        urdf = urdf or bag.robot_description
        own = list(bag.samples)
        ahead = samples[-1].stamp + own[1].stamp - own[0].stamp - own[0].stamp if samples else 0
        samples += [sample._replace(stamp=sample.stamp + ahead) for sample in own]
    text = robot_description(settings, urdf)
    return Recording(replace(settings, robot_description=text, robot_description_file=''), samples,
                     arm_of(settings, text))


def arm_of(settings: Settings, urdf: str) -> Arm:
    """The simulator's arm, which shares no code with the model."""
    return Arm.from_urdf(urdf, moving_joints(settings, urdf), settings.outputs, settings.sensor_frame or None,
                         settings.wrench_convention)


def with_rests(samples: list[Sample], rng: np.random.Generator) -> list[Sample]:
    """Held at the slowest sample about each of ``RESTS_AT``."""
    period = int(np.median(np.diff([sample.stamp for sample in samples])))
    jitter = np.std(np.diff([sample.outputs for sample in samples], axis=0), axis=0) / np.sqrt(2)
    slowest = [min(range(round(len(samples) * (share - 0.05)), round(len(samples) * (share + 0.05))),
                   key=lambda index: float(np.abs(samples[index].velocity).max())) for share in RESTS_AT]
    result: list[Sample] = []
    for index, sample in enumerate(samples):
        if index in slowest:
            zeros = np.zeros_like(sample.velocity)
            result += [sample._replace(velocity=zeros, acceleration=zeros,
                                       outputs=sample.outputs + 0.3 * jitter * rng.standard_normal(len(jitter)))
                       for _ in range(round(REST_S * 1e9 / period))]
        result.append(sample)
    return [sample._replace(stamp=index * period) for index, sample in enumerate(result)]


def with_force(recording: Recording, samples: list[Sample], force: Array) -> list[Sample]:
    """The same samples while a force (N, 3) [N] in base axes acts on the last link."""
    position = np.array([sample.position for sample in samples])
    pose = recording.arm.pose(recording.arm.tip, position)
    change = recording.arm.load_of_force(pose, force, position)
    return [sample._replace(outputs=sample.outputs + row) for sample, row in zip(samples, change, strict=True)]


def loaded(recording: Recording, samples: list[Sample], kilograms: float) -> list[Sample]:
    """With a weight from the first to the second of ``LOAD_AT``."""
    force = np.zeros((len(samples), 3))
    force[round(LOAD_AT[0] * len(samples)):round(LOAD_AT[1] * len(samples)), 2] = -9.81 * kilograms
    return with_force(recording, samples, force)


def touched(recording: Recording, samples: list[Sample], free: Run, every_s: float,
            rng: np.random.Generator) -> tuple[list[Sample], list[Push]]:
    """With pushes."""
    times = np.array([sample.stamp for sample in samples]) * 1e-9
    peaks = Peaks(free, samples)
    force, pushes = np.zeros((len(samples), 3)), []
    for begin in np.arange(20.0, times[-1] - every_s, every_s):
        start = begin + rng.uniform(0.0, 0.7 * every_s)
        newton = FORCES_N[0] * (FORCES_N[1] / FORCES_N[0]) ** rng.uniform()
        length, direction = rng.uniform(*PUSH_S), rng.standard_normal(3)
        rows = np.flatnonzero((times >= start) & (times < start + length))
        if not len(rows):
            continue
        share = (times[rows] - start) / length
        shape = np.minimum(1.0, np.minimum(share, 1.0 - share) / 0.2)[:, None]
        force[rows] = newton * shape * direction / np.linalg.norm(direction)
        own = [samples[row] for row in rows]
        change = np.array([after.outputs - before.outputs for after, before in zip(
            with_force(recording, own, force[rows]), own, strict=True)])
        usual = peaks.usual(start, start + length)
        pushes.append(Push(start, start + length, newton, float((np.abs(change).max(0) / usual).max())))
    return with_force(recording, samples, force), pushes


def run(settings: Settings, samples: list[Sample]) -> Run:
    """The estimator behind the gate, sample by sample."""
    estimator = build_estimator(settings)
    gate = ContactGate.of(estimator.body)
    innovations, closed = [], []
    for sample in samples:
        prediction = estimator.predict(sample)
        closed.append(gate.judge(prediction, settings))
        innovations.append(sample.outputs - prediction.model_mean)
        estimator.observe(prediction, not closed[-1])
    return Run(1e-9 * np.array([sample.stamp for sample in samples]), np.array(innovations), np.array(closed))


class Peaks:
    """Largest innovations in blocks of a run without pushes."""

    def __init__(self, free: Run, samples: list[Sample]) -> None:
        starts = np.flatnonzero(np.diff((free.times // BLOCK_S).astype(int), prepend=-1))
        self.times = free.times[starts]
        self.moves = np.maximum.reduceat(np.abs([sample.velocity for sample in samples]).max(1), starts) > SPEEDS[0]
        self.peaks = np.maximum.reduceat(np.abs(free.innovations), starts)

    def usual(self, start: float, end: float) -> Array:
        """(n,) median about a push from ``start`` to ``end`` [s]."""
        during = (self.times >= start - BLOCK_S) & (self.times < end)
        near = (self.times >= start - ABOUT_S) & (self.times < end + ABOUT_S)
        alike = near & (self.moves == self.moves[during].any())
        return np.asarray(np.median(self.peaks[alike if alike.any() else near], axis=0))


def figures(recording: Recording, every_s: float, kilograms: float, seed: int) -> dict[str, Any]:
    """Counts of one seed."""
    rng = np.random.default_rng(seed)
    samples = loaded(recording, with_rests(recording.samples, rng), kilograms)
    free = run(recording.settings, samples)
    pushed, pushes = touched(recording, samples, free, every_s, rng)
    result = run(recording.settings, pushed)
    timeout = recording.settings.gate_timeout
    found = [bool(result.closed[(result.times >= push.start) & (result.times < push.end + FOUND_AFTER_S)].any())
             for push in pushes]
    end = result.times[-1]
    changes = [share * end for share in LOAD_AT]
    lifts = [(change - 0.1, change + timeout + CALM_AFTER_S) for change in changes]
    known = lifts + [(push.start, push.end + CALM_AFTER_S) for push in pushes]
    alarms, false = free.closures_outside(lifts), result.closures_outside(known)
    quiet = ~np.any([(result.times >= start) & (result.times <= stop) for start, stop in known], axis=0)
    return {'seed': seed, 'minutes': end / 60, 'free_alarms_s': alarms, 'false_alarms_s': false,
            'quiet_hours': float(quiet.sum() / len(quiet) * end / 3600),
            'closed_share_loaded': float(result.closed[quiet & (result.times > changes[0])].mean()),
            'pushes': [{'found': hit, **push._asdict()} for hit, push in zip(found, pushes, strict=True)]}


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Over all seeds."""
    pushes = [push for each in runs for push in each['pushes']]
    hours = sum(each['minutes'] for each in runs) / 60
    by_size = []
    for low, high in itertools.pairwise(CLASSES):
        members = [push for push in pushes if low <= push['size'] < high]
        if members:
            by_size.append({'from': low, 'pushes': len(members), 'found': sum(push['found'] for push in members),
                            'mean_force': float(np.mean([push['force'] for push in members]))})
    outstanding = [push['found'] for push in pushes if push['size'] >= STANDS_OUT]
    return {'hours': hours, 'free_alarms': sum(len(each['free_alarms_s']) for each in runs),
            'quiet_hours': sum(each['quiet_hours'] for each in runs),
            'false_alarms': sum(len(each['false_alarms_s']) for each in runs),
            'closed_share_loaded': max(each['closed_share_loaded'] for each in runs),
            'outstanding': len(outstanding), 'outstanding_found': sum(outstanding), 'by_size': by_size}


def main() -> int:
    """One line for each variant, and everything as JSON on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('recordings', nargs='*')
    parser.add_argument('--params', help='parameter file of the recordings')
    parser.add_argument('--urdf', help='simulate this arm, measured by its joint efforts')
    parser.add_argument('--variants', nargs='+', default=['P', 'SPK-ML'])
    parser.add_argument('--features', type=int, default=100)
    parser.add_argument('--initial', type=int, default=1000)
    parser.add_argument('--seconds', type=float, default=600.0)
    parser.add_argument('--rate', type=float, default=50.0)
    parser.add_argument('--every', type=float, default=20.0, help='seconds from push to push')
    parser.add_argument('--load', type=float, default=1.5, help='weight that is carried for a time [kg]')
    parser.add_argument('--alarms', type=float, default=2.0, help='gate.false_alarms_per_hour')
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--json')
    given = parser.parse_args()
    if bool(given.recordings) != bool(given.params):
        parser.error('recordings and --params belong together.')
    everything: dict[str, Any] = {}
    for variant in given.variants:
        runs = []
        for seed in range(given.seeds):
            urdf = Path(given.urdf).read_text() if given.urdf else None
            recording = recorded(given.recordings, given.params) if given.recordings else simulated(
                urdf, given.seconds, given.rate, seed)
            settings = replace(recording.settings, variant=variant, features_count=given.features, gate_enabled=True,
                               initial_samples=given.initial, gate_false_alarms_per_hour=given.alarms)
            runs.append(figures(recording._replace(settings=settings), given.every, given.load, seed))
            times = [np.round(runs[-1][name], 1).tolist() for name in ('free_alarms_s', 'false_alarms_s')]
            print(f'{variant} seed {seed}: false alarms at {times[0]} s, with pushes at {times[1]} s', file=sys.stderr)
        total = summary(runs)
        everything[variant] = {'summary': total, 'runs': runs}
        print(f'{variant}: {total["free_alarms"]} false alarms in {total["hours"]:.2f} h; '
              f'{total["outstanding_found"]} of {total["outstanding"]} outstanding pushes found, beside '
              f'{total["false_alarms"]} false alarms in {total["quiet_hours"]:.2f} h; '
              f'closed {100 * total["closed_share_loaded"]:.1f} % of the time after the load')
        for row in total['by_size']:
            print(f'    from {row["from"]:g} usual peaks: {row["found"]} of {row["pushes"]} found, mean force '
                  f'{row["mean_force"]:.0f} N')
    if given.json:
        Path(given.json).write_text(json.dumps(everything, indent=1))
    return 0


if __name__ == '__main__':
    sys.exit(main())
