"""What fewer features, and learning less often, save and cost in error: measured recordings, SPK.

    python benchmarks/cost_and_error.py FOLDER --seeds 3

The first recording is learnt, its initial window gives the hyperparameters; the second one is predicted, then learnt.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from semiparam_ros.core.initial_window import gathered_from
from semiparam_ros.experiments.initial_window import fitted_settings
from semiparam_ros.settings import Settings
from semiparam_ros.settings.build import build_estimator

sys.path.insert(0, str(Path(__file__).resolve().parent))  # for a start by its path

from bands import Pair, figures, follow, pairs

COUNTS: tuple[int | str, ...] = (500, 100, 200, 'auto')
SPARING: tuple[tuple[int, float], ...] = ((2, 0.0), (4, 0.0), (1, 0.1), (1, 0.3))
"""learn.every and learn.least_gain, with the first of the counts."""


def variations(pair: Pair, seed: int) -> Iterator[Settings]:
    """Fitted settings to compare, the reference first."""
    window = pair.train[gathered_from(pair.train, pair.settings.initial_samples).indices]
    for count in COUNTS:
        fitted, _ = fitted_settings(replace(pair.settings, features_count=count, features_seed=seed), window, pair.urdf)
        yield fitted
        if count == COUNTS[0]:
            for every, gain in SPARING:
                yield replace(fitted, learn_every=every, learn_least_gain=gain)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('folder', type=Path, help='as that of bands.py')
    parser.add_argument('--seeds', type=int, default=1, help='draws of the features (default: %(default)s)')
    args = parser.parse_args()
    print('| recording | draw | D | learn.every | learn.least_gain | nMSE | over the first | passed over | us |')
    for pair in pairs(args.folder):
        for seed in range(args.seeds):
            reference = 0.0
            for settings in variations(pair, seed):
                estimator = build_estimator(settings, pair.urdf, pair.train.origin)
                start = time.process_time()
                follow(estimator, pair.train, learn=True)
                estimator.begin_recording(pair.test.origin)
                error = figures(follow(estimator, pair.test, learn=True))['nmse']
                count = len(pair.train) + len(pair.test)
                microseconds = 1e6 * (time.process_time() - start) / count
                reference = reference or error
                print(f'| {pair.name} | {seed} | {settings.features_count} | {settings.learn_every} | '
                      f'{settings.learn_least_gain:g} | {error:.4f} | {error / reference - 1.0:+.1%} | '
                      f'{estimator.passed_over / count:.0%} | {microseconds:.0f} |', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
