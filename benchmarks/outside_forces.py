"""External wrench in free motion, touches noticed, and the link that was touched.

    python benchmarks/outside_forces.py                                        a simulated iCub arm with its sensor
    python benchmarks/outside_forces.py --urdf ur3.urdf                        a simulated arm of joint efforts
    python benchmarks/outside_forces.py id1.mcap id2.mcap --params ur3.yaml    recordings of free motion, in this order

Each seed is run once as it is and once with touches: a force of 10 N that rises within 10 ms, half a
second long, in a random direction, at a random place of a random link that the outputs feel, 4 cm
beside its bone; added to the outputs by the Jacobian of the simulator, which shares no code with
the model. A touch is *noticed* when the contact gate closes within 50 ms of it, *felt* when it
changes some output by more than ``FELT`` times the usual peak of its innovations. The link is that
of the highest probability when the touch is over. Free motion counts from the second minute on.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np

from contact_gate import Recording, recorded, simulated
from semiparam_ros.core.robot.external_wrench import ExternalWrench
from semiparam_ros.core.samples import Sample
from semiparam_ros.core.types import Array
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.online.learner import Answer

TOUCH_S, RISE_S, NOTICED_S = 0.5, 0.01, 0.05
BESIDE_M = 0.04
FELT = 2.0
SETTLED_S = 60.0
BLOCK_S = 0.5


class Touch(NamedTuple):
    """Where a touch is, when [s] from the first sample, and how far it stands out."""

    link: str
    start: float
    size: float


class Run(NamedTuple):
    """(N,) times [s], (N, 6) external wrenches and deviations, (N, n) residuals, (N,) gate, and its likeliest link."""

    times: Array
    wrench: Array
    std: Array
    residual: Array
    closed: Array
    link: list[str]


def run(recording: Recording, samples: list[Sample]) -> Run:
    """The commands' learner, sample by sample."""
    learner = OfflineLearner(recording.settings, [], lambda: None)
    external = ExternalWrench(learner.estimator.body)
    rows: list[tuple[Array, Array, Array]] = []

    def keep(answer: Answer, widening: Array) -> None:
        found = external.of(answer.prediction, answer.residual, widening, answer.followed)
        rows.append((found.wrench, found.std, answer.residual))

    learner.on_answer, closed, link = keep, [], []
    for sample in samples:
        learner.step(sample, True)
        closed.append(learner.learner.gate.closed)
        places, _ = learner.learner.gate.places()
        assert learner.learner.gate.place is not None
        link.append(learner.learner.gate.place.links[int(places.argmax())] if places.any() else '')
    wrench, std, residual = (np.array(column) for column in zip(*rows, strict=True))
    return Run(1e-9 * np.array([sample.stamp - samples[0].stamp for sample in samples]), wrench, std, residual,
               np.array(closed), link)


def ends_of(recording: Recording, link: str) -> list[Array]:
    """(3,) where the link's next joints are, or what is fixed to it, in its joint's frame; at least one."""
    model = recording.arm.model
    joint = model.frames[recording.arm.frame_id(link)].parentJoint
    found = [model.jointPlacements[child].translation for child in range(1, model.njoints)
             if model.parents[child] == joint]
    found += [frame.placement.translation for frame in model.frames if frame.parentJoint == joint]
    return max(([end] for end in found), key=lambda ends: float(np.linalg.norm(ends[0])))


def touched(recording: Recording, samples: list[Sample], free: Run, links: tuple[str, ...], every_s: float,
            rng: np.random.Generator) -> tuple[list[Sample], list[Touch]]:
    """The same samples with touches."""
    arm, result, touches = recording.arm, list(samples), []
    starts = np.flatnonzero(np.diff((free.times // BLOCK_S).astype(int), prepend=-1))
    peaks = np.maximum.reduceat(np.abs(free.residual), starts)
    for begin in np.arange(SETTLED_S, free.times[-1] - every_s, every_s):
        start = begin + rng.uniform(0.0, every_s - 2 * TOUCH_S - 1.0)
        rows = np.flatnonzero((free.times >= start) & (free.times < start + TOUCH_S))
        if not len(rows) or free.closed[rows[0] - 1]:
            continue
        link = str(rng.choice(links))
        model = arm.model
        frame = model.frames[arm.frame_id(link)]
        position = np.array([samples[row].position for row in rows])
        pose = arm.pose(link, position)
        beside = rng.standard_normal(3)
        point = rng.uniform(0.2, 1.0) * ends_of(recording, link)[0] + BESIDE_M * beside / np.linalg.norm(beside)
        lever = np.einsum('nij,j->ni', pose.rotation, frame.placement.actInv(point))
        direction = rng.standard_normal(3)
        share = np.minimum(1.0, (free.times[rows] - start) / RISE_S)[:, None]
        force = 10.0 * share * direction / np.linalg.norm(direction)
        change = arm.load_of_force(pose, force, position, np.cross(lever, force))
        near = (free.times[starts] > start - 15.0) & (free.times[starts] < start + 15.0)
        size = float((np.abs(change).max(0) / np.median(peaks[near], axis=0)).max())
        touches.append(Touch(link, start, size))
        for row, added in zip(rows, change, strict=True):
            result[row] = samples[row]._replace(outputs=samples[row].outputs + added)
    return result, touches


def figures(recording: Recording, noise: Array | None, every_s: float, seed: int) -> dict[str, Any]:
    """Of one seed."""
    free = run(recording, recording.samples)
    quiet = (free.times > SETTLED_S) & ~free.closed
    links = OfflineLearner(recording.settings, [], lambda: None).learner.gate.place
    assert links is not None
    pushed, touches = touched(recording, recording.samples, free, links.links, every_s, np.random.default_rng(seed))
    found = run(recording, pushed)
    noticed, right = [], []
    for touch in touches:
        rows = np.flatnonzero((found.times >= touch.start) & (found.times < touch.start + TOUCH_S))
        soon = found.times[rows] <= touch.start + NOTICED_S
        noticed.append(bool(found.closed[rows[soon]].any()))
        named = [found.link[row] for row in rows if found.link[row]]
        right.append((named or [''])[-1] == touch.link)
    rms = np.sqrt(np.mean(free.wrench[quiet] ** 2, axis=0))
    told = {'seed': seed, 'hours': float(quiet.mean() * free.times[-1] / 3600),
            'free_alarms': int((np.diff(free.closed[free.times > SETTLED_S].astype(int)) == 1).sum()),
            'rms': rms.tolist(), 'told_std': np.sqrt(np.mean(free.std[quiet] ** 2, axis=0)).tolist(),
            'touches': [{**touch._asdict(), 'noticed': one, 'right': other}
                        for touch, one, other in zip(touches, noticed, right, strict=True)]}
    if noise is not None:
        residual = np.sqrt(np.mean(free.residual[quiet] ** 2, axis=0))
        told['over_noise'] = float(np.sqrt(np.mean((residual / noise) ** 2)))
    return told


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Over all seeds."""
    touches = [touch for each in runs for touch in each['touches']]
    felt = [touch for touch in touches if touch['size'] >= FELT]
    shares: dict[str, Any] = {}
    for name, chosen in ('all', touches), ('felt', felt):
        count = max(len(chosen), 1)
        seen = [touch for touch in chosen if touch['noticed']]
        shares[name] = {'touches': len(chosen), 'noticed': sum(touch['noticed'] for touch in chosen) / count,
                        'link_right': sum(touch['right'] for touch in seen) / max(len(seen), 1)}
    rms = np.array([each['rms'] for each in runs])
    return {'hours': sum(each['hours'] for each in runs), 'free_alarms': sum(each['free_alarms'] for each in runs),
            'force_rms_N': float(np.sqrt((rms[:, :3] ** 2).mean())),
            'torque_rms_Nm': float(np.sqrt((rms[:, 3:] ** 2).mean())),
            'over_noise': float(np.mean([each['over_noise'] for each in runs])) if 'over_noise' in runs[0] else None,
            **shares}


def main() -> int:
    """One line, and everything as JSON on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('recordings', nargs='*')
    parser.add_argument('--params', help='parameter file of the recordings')
    parser.add_argument('--urdf', help='simulate this arm, measured by its joint efforts')
    parser.add_argument('--variant', default='SPK-ML')
    parser.add_argument('--features', type=int, default=100)
    parser.add_argument('--initial', type=int, default=1000)
    parser.add_argument('--seconds', type=float, default=600.0)
    parser.add_argument('--rate', type=float, default=100.0)
    parser.add_argument('--every', type=float, default=11.0, help='seconds from touch to touch')
    parser.add_argument('--alarms', type=float, default=1.0, help='gate.false_alarms_per_hour')
    parser.add_argument('--seeds', type=int, default=2)
    parser.add_argument('--json')
    given = parser.parse_args()
    if bool(given.recordings) != bool(given.params):
        parser.error('recordings and --params belong together.')
    runs = []
    for seed in range(given.seeds):
        urdf = Path(given.urdf).read_text() if given.urdf else None
        noise = None
        if given.recordings:
            recording = recorded(given.recordings, given.params)
        else:
            recording = simulated(urdf, given.seconds, given.rate, seed)
            noise = recording.noise_std
        settings = replace(recording.settings, variant=given.variant, features_count=given.features, gate_enabled=True,
                           initial_samples=given.initial, gate_false_alarms_per_hour=given.alarms)
        runs.append(figures(recording._replace(settings=settings), noise, given.every, seed))
    told = summary(runs)
    print(json.dumps(told, indent=1))
    if given.json:
        Path(given.json).write_text(json.dumps({'summary': told, 'runs': runs}, indent=1) + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
