"""Draws docs/images/learning.png: predictions and errors of the first half minute of a recording.

    python docs/images/learning.py [PICTURE]
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')  # read when numpy loads

import numpy as np
from matplotlib.figure import Figure

from semiparam_ros import build_estimator, load_params, load_samples

REPOSITORY = Path(__file__).resolve().parents[2]
CHANNEL, NAME = 4, 'torque $t_y$ [N m]'
SECONDS, RATE_HZ, WINDOW = 30.0, 20, 40
MEASURED, LEARNT, DESCRIBED = '#52616f', '#2f6fd0', '#dd8a00'


def main(picture: Path) -> None:
    settings = replace(load_params(REPOSITORY / 'config/icub_right_arm.yaml'), initial_samples=200, features_count=200)
    bag = load_samples(REPOSITORY / 'bags/icub_xy.mcap', settings)
    samples = bag.samples[:int(SECONDS * RATE_HZ)]
    online = build_estimator(settings, bag.robot_description)
    described = build_estimator(settings, bag.robot_description)
    answers = [online.step(sample) for sample in samples]
    mean, std = (np.array([getattr(answer, name) for answer in answers]) for name in ('mean', 'std'))
    urdf = np.array([described.predict(sample).mean for sample in samples])
    draw(picture, samples, mean, std, urdf)


def draw(picture: Path, samples, mean, std, urdf) -> None:
    figure = Figure(figsize=(9.0, 5.0), layout='constrained')
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    time, scale = samples.time, samples.outputs.std(axis=0)
    above.plot(time, urdf[:, CHANNEL], color=DESCRIBED, linewidth=1.0, label='the robot description alone')
    low, high = (mean[:, CHANNEL] + sign * 2.0 * std[:, CHANNEL] for sign in (-1.0, 1.0))
    above.fill_between(time, low, high, color=LEARNT, alpha=0.2, linewidth=0.0, label='95 % band')
    above.plot(time, mean[:, CHANNEL], color=LEARNT, linewidth=1.1, label='predicted, then learnt')
    above.plot(time, samples.outputs[:, CHANNEL], '.', color=MEASURED, markersize=2.2, label='measured')
    span = samples.outputs[:, CHANNEL]
    above.set(ylabel=NAME, ylim=(span.min() - 0.5 * np.ptp(span), span.max() + 0.7 * np.ptp(span)))
    above.legend(ncols=4, fontsize='small', loc='upper right', frameon=False)
    for predicted, colour in ((urdf, DESCRIBED), (mean, LEARNT)):
        squares = np.mean(((predicted - samples.outputs) / scale) ** 2, axis=1)
        smooth = np.convolve(squares, np.full(WINDOW, 1.0 / WINDOW), mode='valid')
        below.plot(time[WINDOW - 1:], smooth, color=colour)
    below.set(yscale='log', xlabel='time since the first sample [s]', ylabel='squared error\nover variance')
    below.axvline(200 / RATE_HZ, color=MEASURED, linewidth=0.8, linestyle=':')
    below.annotate('hyperparameters found,\nfeatures join in', (200 / RATE_HZ, 0.5), xytext=(6, 0), fontsize='small',
                   textcoords='offset points', color=MEASURED, va='center')
    for panel in (above, below):
        panel.grid(alpha=0.25)
        panel.spines[['top', 'right']].set_visible(False)
        panel.set_xlim(0.0, SECONDS)
    figure.savefig(picture, dpi=120)


if __name__ == '__main__':
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_suffix('.png'))
