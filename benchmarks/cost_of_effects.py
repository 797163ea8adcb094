"""What declared effects cost: ``python benchmarks/cost_of_effects.py ROBOTS``.

ROBOTS is the folder ``robots`` of example-robot-data. Viscous and dry friction and an offset of every joint are
declared on two simulated arms, in several forms, which take turns. Medians of a sample (predicted, then learnt) and of
a desired state, and the mean of all that is done with a sample in the node, where the contact gate and the search for
changes come beside; one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

os.environ.setdefault('OMP_NUM_THREADS', '1')
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))

import numpy as np

from carries_over import Pair, pairs
from semiparam_ros.core.samples import Sample, Samples
from semiparam_ros.experiments.evaluation import OfflineLearner

ARMS = ('UR5 (simulated)', 'xArm7 (simulated)')
LEARNT, TIMED, ROUNDS = 5000, 200, 7
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


def begun(pair: Pair, variant: str, effects: tuple[str, ...]) -> OfflineLearner:
    """A learner that has its hyperparameters."""
    learner = OfflineLearner(replace(pair.settings, effects=effects, variant=variant), [], lambda: None)
    learner.begin(pair.first.origin)
    for sample in pair.first[:LEARNT]:
        learner.step(sample, True)
    assert learner.estimator.ready, 'its initial window is not over'
    return learner


def whole(learner: OfflineLearner, samples: Samples) -> float:
    """Mean [us] of all that is done with a sample: what ends a block of motion comes once in many."""
    start = time.perf_counter()
    for sample in samples:
        learner.step(sample, True)
    return 1e6 * (time.perf_counter() - start) / len(samples)


def costs(pair: Pair, variant: str) -> Iterator[dict[str, Any]]:
    """Runs: [us] of a sample and of a desired state, and of a sample in the node, a figure each round; the forms take
    turns in every round."""
    forms = {name: declared(pair.settings.joints, dry) for name, dry in DRY.items()}
    models = {name: begun(pair, variant, effects).estimator for name, effects in forms.items()}
    learners = {name: begun(pair, variant, effects) for name, effects in forms.items()}
    taken: dict[str, list[tuple[float, float, float]]] = {name: [] for name in forms}
    for start in range(LEARNT, LEARNT + ROUNDS * TIMED, TIMED):
        for name, model in models.items():
            rest = pair.first[start:start + TIMED]
            taken[name].append((timed(lambda sample, model=model: model.observe(model.predict(sample)), rest),
                                timed(lambda sample, model=model: model.predict_desired(*sample[1:4]), rest),
                                whole(learners[name], rest)))
    for name, effects in forms.items():
        sample, desired, learner = zip(*taken[name], strict=True)
        yield {'arm': pair.name, 'variant': variant, 'declared': name, 'effects': len(effects),
               'sample_us': sample, 'desired_us': desired, 'learner_us': learner}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('robots', type=Path)
    parser.add_argument('--json', type=Path, metavar='FILE')
    args = parser.parse_args()
    runs: list[dict[str, Any]] = []
    print('| arm | variant | declared | effects | sample [us] | desired state [us] | in the node [us] |')
    chosen = (pair for pair in pairs(None, args.robots) if pair.name in ARMS)
    for pair in islice(chosen, len(ARMS)):
        for variant in ('SPK-ML', 'P'):
            for run in costs(pair, variant):
                runs.append(run)
                sample, desired, learner = (np.median(run[name]) for name in ('sample_us', 'desired_us', 'learner_us'))
                print(f'| {run["arm"]} | {variant} | {run["declared"]} | {run["effects"]} '
                      f'| {sample:.0f} | {desired:.0f} | {learner:.0f} |', flush=True)
    if args.json:
        document = json.dumps({'command': 'cost_of_effects', 'runs': runs}, indent=1)
        args.json.write_text(document + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
