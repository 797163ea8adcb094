"""What declared effects cost: ``python benchmarks/cost_of_effects.py ROBOTS``.

ROBOTS is the folder ``robots`` of example-robot-data. Viscous and dry friction and an offset of every joint are
declared on two simulated arms, in several forms. Medians of a sample (predicted, then learnt) and of a desired state,
one thread.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))

import numpy as np

from carries_over import Pair, pairs
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.experiments.evaluation import OfflineLearner

ARMS = ('UR5 (simulated)', 'xArm7 (simulated)')
LEARNT, TIMED = 1250, 400
DRY: dict[str, Callable[[int], str]] = {
    'none': lambda joint: '',
    'dry friction alike': lambda joint: '{"turn_speed": 0.01}',
    'each in its own form': lambda joint: f'{{"turn_speed": {0.005 * (joint + 1)}}}',
    'presliding': lambda joint: '{"presliding": 0.01}',
}


def declared(joints: tuple[str, ...], dry: Callable[[int], str]) -> tuple[str, ...]:
    """Three effects of each joint."""
    return tuple(text for index, joint in enumerate(joints) if dry(index) for text in (
        f'viscous_friction@{joint}', f'coulomb_friction@{joint}{dry(index)}', f'effort_offset@{joint}'))


def timed(call: Callable[[Sample], object], samples: Samples) -> float:
    """Median [us] of a call for each sample."""
    taken = []
    for sample in samples:
        start = time.perf_counter()
        call(sample)
        taken.append(time.perf_counter() - start)
    return 1e6 * float(np.median(taken))


def costs(pair: Pair, variant: str, effects: tuple[str, ...]) -> tuple[float, float]:
    """[us] Of a sample, and of a desired state."""
    settings = replace(pair.settings, effects=effects, variant=variant)
    learner = OfflineLearner(settings, [], lambda: None)
    learner.begin(pair.first.origin)
    for sample in pair.first[:LEARNT]:
        learner.step(sample, True)
    model, rest = learner.estimator, pair.first[LEARNT:LEARNT + TIMED]
    return (timed(lambda sample: model.observe(model.predict(sample)), rest),
            timed(lambda sample: model.predict_desired(*sample[1:4]), rest))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('robots', type=Path)
    args = parser.parse_args()
    print('| arm | variant | effects | declared | sample [us] | desired state [us] |')
    for pair in pairs(None, args.robots):
        for variant in ('SPK-ML', 'P') if pair.name in ARMS else ():
            for name, dry in DRY.items():
                effects = declared(pair.settings.joints, dry)
                sample, ahead = costs(pair, variant, effects)
                print(f'| {pair.name} | {variant} | {len(effects)} | {name} | {sample:.0f} | {ahead:.0f} |',
                      flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
