"""Every variant with every kind of effect declared, beside the same variant without it, on recordings.

A declared effect may be of no use, and the initial window may not excite it; it must never do harm. Each model learns
the recording as the node does, sample by sample, and is judged by what it predicts after its initial window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from semiparam_ros.bags.conversion import Edits, convert_bag
from semiparam_ros.bags.loading import load_samples
from semiparam_ros.bags.reader import open_bag
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.core.estimator import Estimator
from semiparam_ros.core.model import ModelOptions
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.effects import Effect, effect_to_text, kinds
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.settings import Settings, load_params
from semiparam_ros.settings.build import build_rigid_body
from semiparam_ros.simulation.scenario import Scenario
from semiparam_ros.simulation.simulate import simulate
from support.arms import ICUB_JOINTS, ICUB_SENSOR, icub_table

REPOSITORY = Path(__file__).resolve().parents[2]
MEASURED = REPOSITORY.parent / 'shared' / 'data'
MOST_HARM = 1.1
FEATURES, SAMPLES, DRIFTING = 100, 1500, 600
WINDOW_SHARE, LATE_SHARE = 1 / 3, 0.5
UR3_JOINTS = {'shoulder_pan': 'Base', 'shoulder_lift': 'Shoulder', 'elbow': 'Elbow', 'wrist_1': 'Wrist 1',
              'wrist_2': 'Wrist 2', 'wrist_3': 'Wrist 3'}
FLOOR = 1e-6
"""Normalised errors below it are noise of the arithmetic."""


class Recording(NamedTuple):
    """Samples of a robot as the node gets them."""

    body: RigidBody
    samples: Samples


def bundled(name: str) -> Recording:
    """A recording of bags/."""
    settings = load_params(REPOSITORY / 'config' / 'icub_right_arm.yaml')
    bag = load_samples(REPOSITORY / 'bags' / f'{name}.mcap', settings)
    return Recording(build_rigid_body(settings, bag.robot_description), thinned(bag.samples, 1))


def simulated() -> Recording:
    """Efforts of the package's arm, nothing hidden."""
    recording = simulate(Scenario(samples=SAMPLES, outputs='effort', seed=3))
    return Recording(body_of(recording), samples_of(recording))


def one_way() -> Recording:
    """Efforts of the same arm whose last joint turns one way only until after the window; with friction and noise."""
    body, rng = simulated().body, np.random.default_rng(5)
    time = np.arange(SAMPLES)[:, None] * 0.05
    rate, phase = rng.uniform(0.5, 2.5, 4), rng.uniform(0.0, 6.0, 4)
    rate[-1], phase[-1] = 1.2 * np.pi / time[-1, 0], -0.5 * np.pi
    angle = rate * time + phase
    samples = Samples((time[:, 0] * 1e9).astype(np.int64), 0.6 * np.sin(angle), 0.6 * rate * np.cos(angle),
                      -0.6 * rate**2 * np.sin(angle), np.zeros((SAMPLES, 4)), 0)
    outputs = body.regressors(samples) @ (1.2 * body.base_parameters) + 0.05 * np.tanh(samples.velocity / 0.02)
    return Recording(body, replace(samples, outputs=outputs + 0.005 * rng.standard_normal(outputs.shape)))


def drifting() -> Recording:
    """Efforts of the same arm whose model leaves what drifts for seconds, as on real arms; little of it is white."""
    body, samples = simulated()
    samples, rng = samples[:DRIFTING], np.random.default_rng(4)
    drift = lfilter([np.sqrt(1.0 - 0.99**2)], [1.0, -0.99], rng.standard_normal(samples.outputs.shape), axis=0)
    noise = drift + 0.1 * rng.standard_normal(drift.shape)
    return Recording(body, replace(samples, outputs=samples.outputs + 0.3 * samples.outputs.std(axis=0) * noise))


def ur3(name: str) -> Recording:
    """Measured efforts, which have the opposite sign of the robot description's convention."""
    urdf = (MEASURED / 'ur3_arm/ur3.urdf').read_text()
    for described, recorded in UR3_JOINTS.items():
        urdf = urdf.replace(f'"{described}_joint"', f'"{recorded}"')
    settings = Settings(outputs='effort', robot_description=urdf, joints=tuple(UR3_JOINTS.values()),
                        acceleration_source='filter')
    return measured(settings, MEASURED / f'ur3_arm/{name}.bag', '/arm', -1.0, 4)


def measured(settings: Settings, path: Path, topic: str, sign: float, every: int) -> Recording:
    """A measured bag, each ``every``-th sample of it."""
    with TemporaryDirectory() as folder:
        with open_bag(path) as source, BagWriter(Path(folder) / 'bag.mcap') as written:
            convert_bag(source, Edits({topic: '/joint_states'}, effort_sign=sign), written)
        bag = load_samples(Path(folder) / 'bag.mcap', settings)
    return Recording(build_rigid_body(settings, bag.robot_description), thinned(bag.samples, every))


def panda() -> Recording:
    """Seven joints at 30 Hz."""
    urdf = (MEASURED / 'panda_arm/panda.urdf').read_text().replace('panda_joint', 'fer_joint')
    settings = Settings(outputs='effort', robot_description=urdf, acceleration_source='filter',
                        joints=tuple(f'fer_joint{number}' for number in range(1, 8)))
    return measured(settings, MEASURED / 'panda_arm/panda_exciting_trajectory.db3', '/joint_states', 1.0, 1)


def icub(name: str) -> Recording:
    """The measured iCub: degrees, 29 Hz, the reaction at the sensor."""
    urdf = (MEASURED / 'icub_arm/iCubGenova01.urdf').read_text()
    body = RigidBody.from_urdf(urdf, ICUB_JOINTS, 'wrench', ICUB_SENSOR, 'reaction')
    return Recording(body, thinned(icub_table(MEASURED / f'icub_arm/icubdyn_{name}.dat'), 1))


def thinned(samples: Samples, every: int) -> Samples:
    """At most ``SAMPLES`` of them, from the first on."""
    return samples[slice(0, SAMPLES * every, every)]


RECORDINGS: dict[str, Callable[[], Recording]] = {
    **{name: lambda name=name: bundled(name) for name in ('icub_xy', 'icub_xz', 'icub_undeclared')},
    'simulated_efforts': simulated, 'one_way': one_way, 'drifting': drifting}
MEASURED_RECORDINGS: dict[str, Callable[[], Recording]] = {
    'icub_train': lambda: icub('train'), 'icub_test': lambda: icub('test'), 'ur3_id1': lambda: ur3('id1'),
    'ur3_id2': lambda: ur3('id2'), 'panda': panda}


@cache
def recording(name: str) -> Recording:
    """One of either table."""
    return (RECORDINGS | MEASURED_RECORDINGS)[name]()


def declared(name: str, only: tuple[str, ...] = ()) -> Iterator[Effect]:
    """Every kind at its first and its last place, from the beginning and, if it can, from late in the recording on."""
    body, samples = recording(name)
    residual = samples.outputs - samples.outputs.mean(axis=0)
    for kind in kinds(body.outputs).values():
        places = kind.places(body)
        if (only and kind.kind not in only) or not places:
            continue
        for where in dict.fromkeys((places[0], places[-1])):
            tried = list(kind.searches(body, samples, where, residual)) or [{}]
            for values in (tried[0], tried[-1]) if len(tried) > 1 else tried:
                effect = kind.from_values(where, values, tuple(body.base_parameters))
                yield effect
                if not effect.is_calibration:
                    late = float(samples.time[int(LATE_SHARE * len(samples))])
                    yield effect.with_values(start_s=late)


def error(name: str, variant: str, effect: Effect | None) -> float:
    """Mean normalised error of the predictions after the initial window."""
    body, samples = recording(name)
    window = int(WINDOW_SHARE * len(samples))
    options = ModelOptions(variant=variant, features_count=FEATURES, initial_samples=window)
    estimator = Estimator(body, options, [effect] if effect else [], samples.origin)
    left = np.array([sample.outputs - estimator.step(sample).mean for sample in samples])[window:]
    variance = samples.outputs.var(axis=0)
    moving = variance > 0.0
    return float(np.mean(np.mean(left[:, moving] ** 2, axis=0) / variance[moving]))


def outcome(case: tuple[str, str, Effect | None]) -> dict[str, object]:
    """The error of a case, or what it raised."""
    name, variant, effect = case
    found: dict[str, object] = {'recording': name, 'variant': variant, 'effect': effect_text(effect)}
    try:
        return {**found, 'error': error(name, variant, effect)}
    except (SemiparamError, ArithmeticError, ValueError) as failure:
        return {**found, 'failure': f'{type(failure).__name__}: {failure}'}


def effect_text(effect: Effect | None) -> str:
    """Short: without the reference model."""
    return '' if effect is None else effect_to_text(effect, effect.reference)


def harm(found: dict[str, object], plain: dict[str, object]) -> float:
    """The error over that without the effect."""
    if 'failure' in found:
        return float('inf')
    ratio = (float(str(found['error'])) + FLOOR) / (float(str(plain['error'])) + FLOOR)
    return ratio if np.isfinite(ratio) else float('inf')
