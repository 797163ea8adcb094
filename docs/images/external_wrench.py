"""Draws docs/images/external_wrench.png: pushes on a simulated arm, and what the model says of them.

    python docs/images/external_wrench.py [PICTURE]
"""

import os
import sys
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')  # read when numpy loads

import numpy as np
from matplotlib.figure import Figure

from semiparam_ros import Sample, Settings
from semiparam_ros.core.robot.external_wrench import ExternalWrench
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.simulation import Scenario, simulate
from semiparam_ros.simulation.arm import Arm

RATE_HZ, SECONDS, SHOWN_S = 100, 80, 62.0
PUSHES = ((64.0, 64.8, 'r_gripper', (0.0, 10.0, 0.0)), (69.0, 70.0, 'r_upper_arm', (6.0, -6.0, 3.0)),
          (75.0, 75.6, 'r_gripper', (-4.0, 2.0, 3.0)))
TRUE, FOUND, NOTE = '#dd8a00', '#2f6fd0', '#52616f'


def main(picture: Path) -> None:
    found = simulate(Scenario(motion='mixed', samples=RATE_HZ * SECONDS, rate_hz=RATE_HZ, seed=5))
    settings = Settings(robot_description=found.urdf, joints=found.joint_names, outputs='wrench',
                        sensor_frame=found.frame_id, wrench_convention=found.convention, features_count=100,
                        gate_enabled=True)
    arm = Arm.from_urdf(found.urdf, found.joint_names, 'wrench', found.frame_id, found.convention)
    time = 1e-9 * (found.stamps - found.stamps[0])
    outputs, true = found.outputs.copy(), np.zeros((len(time), 3))
    for start, end, link, force in PUSHES:
        rows = (time >= start) & (time < end)
        true[rows] = force
        outputs[rows] += arm.load_of_force(arm.pose(link, found.position[rows]), true[rows], found.position[rows])
    learner = OfflineLearner(settings, [], lambda: None)
    external, wrenches, gate = ExternalWrench(learner.estimator.body), [], learner.learner.gate
    learner.on_answer = lambda answer, widening: wrenches.append(
        external.of(answer.prediction, answer.residual, widening, answer.followed))
    places = []
    for row in zip(found.stamps, found.position, found.velocity, found.acceleration, outputs, strict=True):
        learner.step(Sample(int(row[0]), *row[1:]), True)
        likely, _ = gate.places()
        places.append(gate.place.links[int(likely.argmax())] if likely.any() else '')
    force, std = (np.array([part[:3] for part in parts]) for parts in
                  zip(*((each.wrench, each.std) for each in wrenches), strict=True))
    sensor = arm.pose(found.frame_id, found.position).rotation
    acting = np.einsum('nij,ni->nj', sensor, true)
    draw(picture, time, force, std, acting, places)


def draw(picture, time, force, std, acting, places):
    shown = time > SHOWN_S
    figure = Figure(figsize=(9.0, 4.4), layout='constrained')
    for panel, axis in zip(figure.subplots(3, sharex=True), range(3), strict=True):
        panel.plot(time[shown], acting[shown, axis], color=TRUE, linewidth=1.6, label='acting')
        panel.plot(time[shown], force[shown, axis], color=FOUND, linewidth=0.9, label='~/external_wrench')
        panel.fill_between(time[shown], (force - 2 * std)[shown, axis], (force + 2 * std)[shown, axis], color=FOUND,
                           alpha=0.25, linewidth=0, label='two standard deviations')
        panel.set(ylabel=f'force {"xyz"[axis]} [N]', xlim=(SHOWN_S, time[-1]))
        panel.grid(alpha=0.25)
        panel.spines[['top', 'right']].set_visible(False)
        for start, end, _, _ in PUSHES:
            rows = np.flatnonzero((time >= start) & (time < end))
            link = next((places[row] for row in rows[::-1] if places[row]), '')
            panel.axvspan(start, end, color=NOTE, alpha=0.08)
            if axis == 0:
                panel.annotate(link, (start, panel.get_ylim()[1]), xytext=(0, 2), textcoords='offset points',
                               fontsize='small', color=NOTE)
    panel.set(xlabel='time since the first sample [s]')
    panel.legend(fontsize='small', frameon=False, ncols=3, loc='lower left')
    figure.savefig(picture, dpi=120)


if __name__ == '__main__':
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix('.png'))
