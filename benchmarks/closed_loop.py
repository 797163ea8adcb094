"""Changes of a robot while it works: noticed, named, and told from contacts.

    python benchmarks/closed_loop.py --urdf ur3=ur3.urdf --urdf panda=panda.urdf --data DATA

Simulated arms (the iCub's with its sensor, and each URDF by its joint efforts, with friction in
every joint) move for four minutes at 100 Hz (iCub: 20 Hz). DATA holds the measured recordings of a
UR3, a Franka and an iCub, already converted (``id1.mcap id2.mcap panda.mcap train.mcap
test.mcap``). Into each come, by recursive Newton-Euler and Jacobians that the package's models do
not share: a load in the hand, off and on again; a tool in place of another one; an offset of one
effort, or of the sensor; dry friction of one joint; a base that is knocked by two degrees; a zero
of one joint that slips by two to four; a cable's spring that catches the hand; a torque of no
listed kind; a hand that pushes three times for 5 s; and nothing. Seeds choose masses, joints and
directions.

*Noticed*: within 3 s of motion its state is no longer "as it was". *Named*: the record of it
has the right effect, 30 s after it or when it ends. *Back*: within 30 s of the change, the
error of the predictions is, until the next change and for five seconds at least, within 1.3 times its
floor: that of the same robot which never changes, or was changed from the beginning; and after how
long (median). *False*: changes told of where there is
none, or only a push; those that their naming took back are counted apart.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np
import pinocchio as pin
from rich.console import Console
from rich.table import Table
from scipy.signal import savgol_filter

from semiparam_ros.bags.loading import load_samples
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.signals.differentiation import CausalDifferentiator
from semiparam_ros.core.types import Array
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.online.change_record import ChangeRecord
from semiparam_ros.online.change_watch import STATES
from semiparam_ros.online.usual_peaks import SPEEDS
from semiparam_ros.settings import Settings
from semiparam_ros.settings.robot_description import moving_joints, robot_description
from semiparam_ros.simulation.arm import Arm
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate, true_arm

SECONDS, AT = 240.0, (0.55, 0.7, 0.85)
"""Of a simulated recording; changes as shares of a recording."""
NOTICED_S, NAMED_S, PUSH_S = 3.0, 30.0, 5.0
KNOCKED_RAD, SLIPPED_RAD = np.deg2rad(2.0), np.deg2rad([2.0, 4.0])
BACK, BACK_S = 1.3, 5.0
"""So near its floor, for so long at least, an error is back."""
CHANGES = (
    'load',
    'tool',
    'offset',
    'friction',
    'base',
    'zero',
    'cable',
    'unlisted',
    'push',
    'none',
)
MEASURED = {
    'UR3 measured': (('id1', 'id2'), Settings(outputs='effort')),
    'Franka measured': (
        ('panda',),
        Settings(
            outputs='effort',
            joints=tuple(f'panda_joint{number}' for number in range(1, 8)),
            initial_samples=200,
        ),
    ),
    'iCub measured': (
        ('train', 'test'),
        Settings(
            outputs='wrench',
            joints=('r_shoulder_pitch', 'r_shoulder_roll', 'r_shoulder_yaw', 'r_elbow'),
            sensor_frame='r_arm_ft_sensor',
            wrench_convention='reaction',
        ),
    ),
}
NAMES = {
    'load': ('payload',),
    'tool': ('payload', 'tool_exchange'),
    'base': ('gravity_tilt', 'base_shift'),
    'zero': ('joint_offset', 'zero_slip'),
    'cable': ('cable_spring',),
    'unlisted': (),
    'offset': ('sensor_offset', 'effort_offset'),
    'friction': ('coulomb_friction', 'viscous_friction'),
}


class Robot(NamedTuple):
    """Free motion of an arm, and what loads it."""

    settings: Settings
    samples: Samples
    arm: Arm
    mass: float  # [kg] of a usual load


class Case(NamedTuple):
    """A recording with changes at times [s], and the mass that came [kg]."""

    samples: Samples
    times: tuple[float, ...]
    mass: float
    always: Samples
    """The same with the change from the beginning to the end."""


class Figures(NamedTuple):
    """What became of one case."""

    changes: int
    noticed: int
    named: int
    delays: list[float]  # [s] until a change was told
    mass_errors: list[float]  # as shares
    back: int
    back_s: list[float]  # [s] after the change
    false: int
    retracted: int
    hours: float


def simulated(urdf: str | None, seed: int) -> Robot:
    """An arm in a mixture of circles, Fourier motion and reaching."""
    rate, effects = (20.0, ()) if urdf is None else (100.0, _friction(urdf))
    joints = None if urdf is None else tuple(dict.fromkeys(str(effect.where) for effect in effects))
    scenario = Scenario(
        motion='mixed',
        samples=round(SECONDS * rate),
        rate_hz=rate,
        seed=seed,
        urdf=urdf,
        joints=joints,
        outputs='wrench' if urdf is None else 'effort',
        effects=effects,
        baseline='bundled' if urdf is None else 'none',
        accelerations=False,
        noise_correlation_s=0.05,
    )
    found = simulate(scenario)
    settings = Settings(
        robot_description=found.urdf,
        joints=found.joint_names,
        outputs=found.outputs_kind,
        sensor_frame=found.frame_id,
        wrench_convention='reaction',
    )
    causal = CausalDifferentiator(len(found.joint_names), settings.acceleration_cutoff)
    acceleration = np.array(
        [
            causal.update(int(stamp), velocity)
            for stamp, velocity in zip(found.stamps, found.velocity, strict=True)
        ]
    )
    samples = Samples(
        found.stamps,
        found.position,
        found.velocity,
        acceleration,
        found.outputs,
        int(found.stamps[0]),
    )
    return Robot(settings, samples, true_arm(scenario), 0.3 if urdf is None else 0.6)


def _friction(urdf: str) -> tuple[EffectRequest, ...]:
    arm = Arm.from_urdf(urdf, moving_joints(Settings(outputs='effort'), urdf), 'effort')
    joints = [joint for joint in arm.joints if 'finger' not in joint]
    return tuple(
        EffectRequest(kind, joint, 1.0, 0.0)
        for joint in joints
        for kind in ('coulomb_friction', 'viscous_friction')
    )


def measured(data: Path, names: tuple[str, ...], settings: Settings, _: int = 0) -> Robot:
    """Recordings, one after the other; the same for every seed."""
    bags = [load_samples(data / f'{name}.mcap', settings) for name in names]
    urdf = robot_description(
        settings, next(bag.robot_description for bag in bags if bag.robot_description)
    )
    stamps, end = [], 0
    for bag in bags:
        own = bag.samples.stamps - bag.samples.stamps[0]
        stamps.append(own + end)
        end += int(own[-1] + own[1])
    joined = Samples.joined([bag.samples for bag in bags])
    samples = replace(joined, stamps=np.concatenate(stamps) + 10**9, origin=10**9, breaks=())
    settings = replace(settings, robot_description=urdf, robot_description_file='')
    return Robot(
        settings, samples, arm_of(settings, urdf), 0.3 if settings.outputs == 'wrench' else 0.6
    )


def arm_of(settings: Settings, urdf: str) -> Arm:
    """The simulator's arm, which shares no code with the model."""
    return Arm.from_urdf(
        urdf,
        moving_joints(settings, urdf),
        settings.outputs,
        settings.sensor_frame or None,
        settings.wrench_convention,
    )


def case_of(robot: Robot, change: str, seed: int) -> Case:
    """The recording with one of ``CHANGES``."""
    rng, samples = np.random.default_rng(1000 + seed), robot.samples
    times = tuple(share * float(samples.time[-1]) for share in AT)
    time, n = samples.time, samples.outputs.shape[1]
    spread, mass, added = samples.outputs.std(axis=0), 0.0, np.zeros_like(samples.outputs)
    always = added
    if change == 'load':
        mass = robot.mass * rng.uniform(0.6, 1.4)
        on = ((time >= times[0]) & (time < times[1])) | (time >= times[2])
        always = weight(robot, mass, rng)
        added = on[:, None] * always
    elif change == 'offset':
        jump = rng.choice([-0.5, 0.5], n) * spread
        if robot.settings.outputs == 'effort':
            jump *= np.arange(n) == rng.integers(n)
        always, times = np.broadcast_to(jump, added.shape), times[:1]
        added = (time >= times[0])[:, None] * always
    elif change == 'friction':
        joint = int(rng.integers(n))
        always = np.zeros_like(added)
        always[:, joint] = 0.3 * spread[joint] * np.tanh(samples.velocity[:, joint] / 0.02)
        added, times = (time >= times[0])[:, None] * always, times[:1]
    elif change == 'tool':
        before, always = (weight(robot, robot.mass * rng.uniform(0.6, 1.4), rng) for _ in range(2))
        times = times[:1]
        added = np.where((time >= times[0])[:, None], always, before)
    elif change in ONCE:
        always, times = ONCE[change](robot, rng), times[:1]
        added = (time >= times[0])[:, None] * always
    elif change == 'push':
        added, times = pushes(robot, times, rng), ()
    else:
        times = ()
    changed, unchanging = (
        replace(samples, outputs=samples.outputs + each) for each in (added, always)
    )
    return Case(changed, times, mass, unchanging)


def weight(robot: Robot, mass: float, rng: np.random.Generator) -> Array:
    """(N, n) what a body in the hand adds, by recursive Newton-Euler with and without it."""
    samples, arm = robot.samples, robot.arm
    step = float(np.median(np.diff(samples.time)))
    acceleration = savgol_filter(
        samples.velocity, max(int(0.1 / step) | 1, 7), 3, deriv=1, delta=step, axis=0
    )
    centre = np.array([*rng.uniform(-0.03, 0.03, 2), 0.06])
    body = pin.Inertia(mass, centre, 6e-4 * mass * np.eye(3))
    states = samples.position, samples.velocity, acceleration
    return arm.with_body(arm.distal_frames()[-1], body).evaluate(*states) - arm.evaluate(*states)


def pushes(robot: Robot, times: tuple[float, ...], rng: np.random.Generator) -> Array:
    """(N, n) what a hand adds that pushes the tip by some 10 to 30 N."""
    position, time = robot.samples.position, robot.samples.time
    force = np.zeros((len(time), 3))
    for start in times:
        direction, newton = rng.standard_normal(3), rng.uniform(10.0, 30.0)
        shape = np.clip(np.minimum(time - start, start + PUSH_S - time) / 0.5, 0.0, 1.0)
        sway = 1.0 + 0.2 * np.sin(4.4 * (time - start) + rng.uniform(0.0, 6.3))
        force += newton * (shape * sway)[:, None] * direction / np.linalg.norm(direction)
    return robot.arm.load_of_force(robot.arm.pose(robot.arm.tip, position), force, position)


def knocked(robot: Robot, rng: np.random.Generator) -> Array:
    """(N, n) what a base adds that is turned by two degrees about a horizontal axis."""
    about = rng.uniform(0.0, 2.0 * np.pi)
    turn = pin.exp3(KNOCKED_RAD * np.array([np.cos(about), np.sin(about), 0.0]))
    states = robot.samples.position, robot.samples.velocity, robot.samples.acceleration
    level = robot.arm.model.gravity.linear
    tilted = robot.arm.with_gravity(turn.T @ level)
    return tilted.evaluate(*states) - robot.arm.evaluate(*states)


def slipped(robot: Robot, rng: np.random.Generator) -> Array:
    """(N, n) what a joint adds whose true angle is another than its encoder's, one that the weight
    of the arm turns: a last wrist that hardly weighs anything shows no slip."""
    position, velocity, acceleration = (
        getattr(robot.samples, name) for name in ('position', 'velocity', 'acceleration')
    )
    level = robot.arm.evaluate(position, velocity, acceleration)
    found = []
    for joint in range(position.shape[1]):
        true = position.copy()
        true[:, joint] += rng.choice([-1.0, 1.0]) * rng.uniform(*SLIPPED_RAD)
        found.append(robot.arm.evaluate(true, velocity, acceleration) - level)
    units = 1 if robot.settings.outputs == 'effort' else 2
    spread = robot.samples.outputs.std(axis=0).reshape(units, -1)
    largest = np.repeat(spread.max(axis=1), spread.shape[1])
    felt = np.array([np.sqrt(np.mean((each / largest) ** 2)) for each in found])
    return found[rng.choice(np.flatnonzero(felt >= 0.3 * felt.max()))]


def caught(robot: Robot, rng: np.random.Generator) -> Array:
    """(N, n) what a spring adds from the tip to a place near its path, of ten newtons or so."""
    pose = robot.arm.pose(robot.arm.tip, robot.samples.position)
    stretched = pose.place - pose.place.mean(axis=0) + rng.uniform(-0.3, 0.3, 3)
    stiffness = 10.0 / np.sqrt(np.mean(np.sum(stretched**2, axis=1)))
    return robot.arm.load_of_force(pose, -stiffness * stretched, robot.samples.position)


def unlisted(robot: Robot, rng: np.random.Generator) -> Array:
    """(N, n) a smooth function of two positions, in one output."""
    position, n = robot.samples.position, robot.samples.outputs.shape[1]
    first, second = rng.choice(position.shape[1], 2, replace=False)
    output = int(rng.integers(n))
    added = np.zeros((len(position), n))
    added[:, output] = np.sin(
        3.0 * position[:, first] - 2.0 * position[:, second] + rng.uniform(0.0, 6.3)
    )
    return 0.3 * robot.samples.outputs.std(axis=0) * added


ONCE = {'base': knocked, 'zero': slipped, 'cable': caught, 'unlisted': unlisted}


def run(robot: Robot, samples: Samples) -> tuple[list[ChangeRecord], Array, Array]:
    """Every record that was told, (N,) whether the state was another than usual, and (N,) mean
    squared errors of the predictions over the outputs' variance."""
    learner, told, unusual = (
        OfflineLearner(robot.settings, [], lambda: None),
        list[ChangeRecord](),
        list[bool](),
    )
    learner.on_change = told.append
    learner.begin(samples.origin)
    predicted = []
    for sample in samples:
        predicted.append(learner.step(sample, learning=True).mean)
        unusual.append(learner.learner.changes.state in STATES[3:5])
    spread = robot.samples.outputs.std(axis=0)
    left = (np.array(predicted) - samples.outputs) / spread
    return told, np.array(unusual), np.mean(left**2, axis=1)


def back_after(time: Array, squares: Array, floor: Array, at: float, until: float) -> float:
    """[s] after ``at`` from which on the squared error (N,) stays within ``BACK`` times its floor
    (N,) until ``until`` and for the next ``BACK_S``; inf where it does not."""
    for start in np.arange(at, min(at + NAMED_S, until - BACK_S), 0.25):
        spans = [(time >= start) & (time < end) for end in (start + BACK_S, until)]
        if all(squares[span].mean() <= BACK**2 * floor[span].mean() for span in spans):
            return float(start - at)
    return float('inf')


def after_motion(samples: Samples, at: float, seconds: float) -> float:
    """[s] when so many seconds of motion have passed since ``at``; nothing shows at rest."""
    time = samples.time
    moves = (np.abs(samples.velocity).max(axis=1) > SPEEDS[0]) & (time >= at)
    moved = np.cumsum(np.diff(time, prepend=time[0]) * moves)
    late = time[moved >= seconds]
    return float(late[0] if len(late) else time[-1])


def judged(robot: Robot, change: str, seed: int) -> Figures:
    """One case."""
    case = case_of(robot, change, seed)
    told, unusual, squares = run(robot, case.samples)
    floors = [
        run(with_auto(robot, 'off'), each)[2] for each in (robot.samples, case.always)[: 2 * bool(case.times)]
    ]
    time, origin = case.samples.time, case.samples.origin

    def seconds(stamp: int | None) -> float:
        return np.nan if stamp is None else (stamp - origin) * 1e-9

    noticed = named = 0
    delays, errors, right = list[float](), list[float](), set[int]()
    ends = [*case.times[1:], float(time[-1])]
    back_s = [
        after
        for number, (at, end) in enumerate(zip(case.times, ends, strict=False))
        if np.isfinite(after := back_after(time, squares, floors[1 - number % 2], at, end))
    ]
    decided = [
        seconds(decision.stamp) for record in told for decision in record.decisions[-1:]
    ] + [seconds(record.change.noticed) for record in told]
    for number, at in enumerate(case.times):
        until = after_motion(case.samples, at, NOTICED_S)
        soon = any(at <= when < until for when in decided)
        noticed += soon or bool(unusual[(time >= at) & (time < until)].any())
        if change == 'load' and number == 1:  # it is put down
            near = [record for record in told if abs(seconds(record.change.ended) - at) < NAMED_S]
            named += bool(near)
            delays += [seconds(near[0].change.noticed) - at] if near else []
            right |= {record.change.number for record in near}
            continue
        near = [record for record in told if at - 3.0 < seconds(record.change.noticed) < at + NAMED_S]
        right |= {record.change.number for record in near}
        delays += [seconds(near[0].change.noticed) - at] if near else []
        found = [
            record
            for record in near
            if record.effect is not None and record.effect.kind in NAMES[change]
        ]
        named += bool(found) if NAMES[change] else not any(record.effect for record in near)
        if found and found[-1].named is not None:
            last = found[-1].named
            errors += (
                [abs(last.parameters['mass'].value / case.mass - 1.0)] if change == 'load' else []
            )
    final = {record.change.number: record.retracted for record in told}
    wrong = [back_taken for number, back_taken in final.items() if number not in right]
    hours = float(time[-1]) / 3600.0
    return Figures(
        len(case.times),
        noticed,
        named,
        delays,
        errors,
        len(back_s),
        back_s,
        len(wrong) - sum(wrong),
        sum(wrong),
        hours,
    )


def summed(rows: list[Figures]) -> list[str]:
    """Cells of a table."""

    def median(values: list[float]) -> str:
        return f'{np.nanmedian(values):.2g}' if values else '-'

    changes = sum(row.changes for row in rows)

    def share(count: int) -> str:
        return f'{count} of {changes}' if changes else '-'

    flat = [
        [value for row in rows for value in getattr(row, name)]
        for name in ('delays', 'mass_errors', 'back_s')
    ]
    worst = f' ({max(flat[1]):.0%})' if flat[1] else ''
    mass = f'{np.median(flat[1]):.1%}{worst}' if flat[1] else '-'
    return [
        share(sum(row.noticed for row in rows)),
        median(flat[0]),
        share(sum(row.named for row in rows)),
        mass,
        share(sum(row.back for row in rows)),
        median(flat[2]),
        f'{sum(row.false for row in rows)} in {sum(row.hours for row in rows):.2f} h',
        str(sum(row.retracted for row in rows)),
    ]


def with_mass(robot: Robot, mass: float | None) -> Robot:
    """The same with another usual load [kg]."""
    return robot if mass is None else robot._replace(mass=mass)


def with_auto(robot: Robot, auto: str) -> Robot:
    """The same with ``diagnosis.auto``."""
    return robot._replace(settings=replace(robot.settings, diagnosis_auto=auto))


def main() -> int:
    """A row for each robot and change."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        '--urdf', action='append', default=[], metavar='NAME=FILE', help='an arm of joint efforts'
    )
    parser.add_argument('--data', type=Path, help='folder of the measured recordings')
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--first-seed', type=int, default=1)
    parser.add_argument('--changes', nargs='+', choices=CHANGES, default=list(CHANGES))
    parser.add_argument('--no-icub', action='store_true', help='without the simulated iCub')
    parser.add_argument('--auto', choices=('report', 'apply'), default='report')
    parser.add_argument('--robots', nargs='+', metavar='NAME', help='these alone')
    parser.add_argument('--mass', type=float, help='[kg] of a usual load (0.3 iCub, 0.6 others)')
    parser.add_argument('--json')
    given = parser.parse_args()
    robots: dict[str, Callable[[int], Robot]] = (
        {} if given.no_icub else {'iCub': partial(simulated, None)}
    )
    for name, _, file in (text.partition('=') for text in given.urdf):
        robots[name] = partial(simulated, Path(file).read_text())
    for name, (bags, settings) in MEASURED.items() if given.data else ():
        robots[name] = partial(measured, given.data, bags, settings)
    robots = {name: robots[name] for name in given.robots or robots}
    table = Table(
        'robot',
        'change',
        'noticed',
        'told after [s]',
        'named',
        'mass error',
        'back',
        'after [s]',
        'false',
        'taken back',
    )
    runs = []
    for name, robot in robots.items():
        for change in given.changes:
            if change == 'friction' and 'iCub' in name:
                continue  # a sensor at the wrist does not feel it
            seeds = range(given.first_seed, given.first_seed + given.seeds)
            only = 1 if change == 'none' and name in MEASURED else None  # nothing is drawn
            rows = [
                judged(with_auto(with_mass(robot(seed), given.mass), given.auto), change, seed)
                for seed in seeds[:only]
            ]
            runs += [{'robot': name, 'change': change, **row._asdict()} for row in rows]
            table.add_row(name, change, *summed(rows))
            print(name, change, *summed(rows), sep=' | ', flush=True)
    Console(width=140).print(table)
    if given.json:
        command = ' '.join(['closed_loop', *sys.argv[1:]])
        Path(given.json).write_text(json.dumps({'command': command, 'runs': runs}, indent=1) + '\n')
    return 0


if __name__ == '__main__':
    sys.exit(main())
