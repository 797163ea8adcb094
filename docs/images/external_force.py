"""Draws docs/images/external_force.png: measured minus modelled force, before and after an export.

    python docs/images/external_force.py [PICTURE]
"""

import os
import sys
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')  # read when numpy loads

import numpy as np
from matplotlib.figure import Figure

from semiparam_ros import RigidBody, effect_from_text, load_params, load_samples
from semiparam_ros.export.estimate import from_recording
from semiparam_ros.export.identified import identify
from semiparam_ros.export.report import remark
from semiparam_ros.export.urdf import described_links, identified_urdf

REPOSITORY = Path(__file__).resolve().parents[2]
DESCRIBED, IDENTIFIED, NOTE = '#dd8a00', '#2f6fd0', '#52616f'
WINDOW = 20


def main(picture: Path) -> None:
    settings = load_params(REPOSITORY / 'config/icub_right_arm.yaml')
    bag = load_samples(REPOSITORY / 'bags/icub_undeclared.mcap', settings)
    frame = (settings.joints, 'wrench', settings.sensor_frame, settings.wrench_convention)
    described = RigidBody.from_urdf(bag.robot_description, *frame)
    estimate = from_recording(described, [effect_from_text('payload@r_hand')], bag.samples, True,
                              False, 'the recording')
    found = identify(estimate, described_links(bag.robot_description))
    identified = RigidBody.from_urdf(
        identified_urdf(bag.robot_description, found, remark(found)), *frame)
    offset = np.array(list(found.offsets.values()))
    figure = Figure(figsize=(9.0, 3.2), layout='constrained')
    panel = figure.subplots()
    for body, colour, label in ((described, DESCRIBED, 'with the robot description'),
                                (identified, IDENTIFIED, 'with the exported one')):
        modelled = body.regressors(bag.samples) @ body.base_parameters
        force = np.linalg.norm((bag.samples.outputs - offset - modelled)[:, :3], axis=1)
        smooth = np.convolve(force, np.full(WINDOW, 1.0 / WINDOW), mode='valid')
        panel.plot(bag.samples.time[WINDOW - 1:], smooth, color=colour, linewidth=1.2, label=label)
    panel.axvline(found.loads[0].start_s, color=NOTE, linewidth=0.8, linestyle=':')
    panel.annotate('picked up', (found.loads[0].start_s, panel.get_ylim()[1]), xytext=(6, -12),
                   textcoords='offset points', fontsize='small', color=NOTE)
    panel.set(xlabel='time since the first sample [s]', ylabel='external force [N]', ylim=(0, None),
              xlim=(0, bag.samples.time[-1]))
    panel.legend(fontsize='small', frameon=False)
    panel.grid(alpha=0.25)
    panel.spines[['top', 'right']].set_visible(False)
    figure.savefig(picture, dpi=120)


if __name__ == '__main__':
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix('.png'))
