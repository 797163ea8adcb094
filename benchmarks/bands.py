"""Bands and pace on recordings: the published mean and standard deviation beside those of the model alone.

    python benchmarks/bands.py --data FOLDER             bundled recordings, and the measured ones where FOLDER has them
    python benchmarks/bands.py --stationary 5            simulated recordings in which nothing changes, five seeds

The first recording is learnt as ``semiparam evaluate`` learns it: its first samples of motion give the hyperparameters,
later ones new hyperparameters where the motion changes; what follows the initial window is predicted and then learnt
(``first``). From there the second recording is predicted, learning it (``learning``) and not (``frozen``); the bundled
one in five parts. The model alone has ``forgetting: 1.0``, no wandering offset and bands that are not calibrated; it is
the same model, so that one run gives both.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np

from semiparam_ros.bags.loading import LoadedBag, load_samples
from semiparam_ros.core.prediction import Prediction, log_density
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Array
from semiparam_ros.core.variants import AVERAGED, CHOICES, MEMBERS, VARIANTS
from semiparam_ros.effects import kinds
from semiparam_ros.experiments.evaluation import OfflineLearner
from semiparam_ros.experiments.scoreboard import samples_of
from semiparam_ros.settings import Settings, load_params
from semiparam_ros.simulation.causes import CAUSES
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate

ROOT = Path(__file__).resolve().parents[1]
BAND = 1.959963984540054
CHANGES = ('sensor_drift', 'thermal_drift', 'payload')
"""Kinds that change while they are recorded."""


class Pair(NamedTuple):
    """Two recordings of one robot; the second one is predicted in so many parts."""

    name: str
    settings: Settings
    train: Samples
    test: Samples
    parts: int
    bag: LoadedBag
    """With the robot description."""


def pairs(folder: Path | None) -> Iterator[Pair]:
    """The bundled recordings, and the measured ones that the folder has: converted by ``semiparam convert``."""
    icub = load_params(ROOT / 'config' / 'icub_right_arm.yaml')
    yield _two('bundled', icub, ROOT / 'bags' / 'icub_xy.mcap', ROOT / 'bags' / 'icub_xz.mcap', 5)
    if folder is None:
        return
    efforts = Settings(outputs='effort')
    yield _two('iCub', icub, folder / 'train.mcap', folder / 'test.mcap')
    yield _two('UR3', efforts, folder / 'id1.mcap', folder / 'id2.mcap')
    franka = replace(efforts, joints=tuple(f'panda_joint{number}' for number in range(1, 8)), initial_samples=300)
    bag = load_samples(folder / 'panda.mcap', franka)
    cut = len(bag.samples) * 6 // 10
    yield Pair('Franka', franka, bag.samples[:cut], bag.samples[cut:], 1, bag)


def _two(name: str, settings: Settings, train: Path, test: Path, parts: int = 1) -> Pair:
    first, second = load_samples(train, settings), load_samples(test, settings)
    return Pair(name, settings, first.samples, second.samples, parts, first)


def follow(learner: OfflineLearner, samples: Samples, learn: bool) -> list[Prediction]:
    """Every sample predicted, then perhaps learnt: from the end of the initial window on, and where the robot moves."""
    learner.begin(samples.origin)
    return [prediction for prediction in (learner.step(sample, learn) for sample in samples)
            if prediction.ready and prediction.motion.is_news]


def figures(predictions: Sequence[Prediction]) -> dict[str, float]:
    """Published and of the model alone: share within 95 % bands, log density [nat], squared error over variance."""
    measured = np.array([prediction.sample.outputs for prediction in predictions])
    mean, std = (np.array([getattr(each, name) for each in predictions]) for name in ('mean', 'std'))
    model_mean, model_std = (np.array([getattr(each, name) for each in predictions])
                             for name in ('model_mean', 'model_std'))
    return {'samples': len(predictions), 'band': _covered(measured - mean, std),
            'model_band': _covered(measured - model_mean, model_std),
            'log_density': float(np.mean([each.log_density for each in predictions])),
            'model_log_density': float(np.mean([_model_log_density(each) for each in predictions])),
            'nmse': _nmse(measured - mean, measured), 'model_nmse': _nmse(measured - model_mean, measured)}


def _covered(errors: Array, std: Array) -> float:
    return float(np.mean(np.abs(errors) <= BAND * std))


def _nmse(errors: Array, measured: Array) -> float:
    variance = measured.var(axis=0)
    moved = variance > 0.0
    return float(np.mean(np.mean(errors**2, axis=0)[moved] / variance[moved]))


def _model_log_density(prediction: Prediction) -> float:
    return log_density(prediction.sample.outputs - prediction.model_mean, prediction.model_covariance)


def run(pair: Pair, variant: str, features: int) -> list[dict[str, Any]]:
    """Figures of one variant on one pair; of averaged ones, and then of each of them, which is as it would be alone."""
    learner = OfflineLearner(replace(pair.settings, variant=variant, features_count=features), [pair.bag], lambda: None)
    phases = {'first': follow(learner, pair.train, learn=True)}
    length = len(pair.test) // pair.parts
    for phase, learn in (('learning', True), ('frozen', False)):
        parts = (pair.test[part * length:(part + 1) * length] for part in range(pair.parts))
        phases[phase] = [prediction for part in parts for prediction in follow(deepcopy(learner), part, learn)]
    each = {variant: phases}
    for index, member in enumerate(MEMBERS if variant == AVERAGED else ()):
        each[f'{member} of {variant}'] = {phase: [one.by_member(index) for one in predictions]
                                          for phase, predictions in phases.items()}
    return [{'recording': pair.name, 'variant': name, 'features': features,
             **{phase: figures(predictions) for phase, predictions in mine.items()}} for name, mine in each.items()]


def stationary(seeds: int, features: int) -> Iterator[dict[str, Any]]:
    """SPK on simulated recordings in which nothing changes: the error with the wandering offset over that without."""
    for outputs in ('wrench', 'effort'):
        names = ['nothing', *(name for name in kinds(outputs) if name in CAUSES and name not in CHANGES)]
        for name in names:
            for seed in range(seeds):
                hidden = () if name == 'nothing' else (EffectRequest(name, size=1.0),)
                recording = simulate(Scenario(motion='circle_xy', samples=4000, seed=seed, outputs=outputs,
                                              effects=hidden))
                settings = Settings(robot_description=recording.urdf, joints=tuple(recording.joint_names),
                                    outputs=outputs, sensor_frame=recording.frame_id or '',
                                    wrench_convention=recording.convention, features_count=features)
                learner = OfflineLearner(settings, [], lambda: None)
                predictions = follow(learner, samples_of(recording), learn=True)
                yield {'outputs': outputs, 'kind': name, 'seed': seed, **figures(predictions)}


def show(result: dict[str, Any]) -> str:
    """One row of the table."""
    cells = [f'{result[phase]["band"]:.1%} ({result[phase]["model_band"]:.1%}) | '
             f'{result[phase]["log_density"]:.2f} ({result[phase]["model_log_density"]:.2f}) | '
             f'{result[phase]["nmse"]:.4f} ({result[phase]["model_nmse"]:.4f})'
             for phase in ('first', 'learning', 'frozen')]
    return f'| {result["recording"]} | {result["variant"]} | {" | ".join(cells)} |'


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--data', type=Path, metavar='FOLDER', help='holds train.mcap and test.mcap (iCub), id1.mcap '
                        'and id2.mcap (UR3) and panda.mcap')
    parser.add_argument('--variant', nargs='+', choices=CHOICES, default=list(VARIANTS))
    parser.add_argument('--features', type=int, default=500, help='D (default: %(default)s)')
    parser.add_argument('--stationary', type=int, metavar='SEEDS', help='the simulated recordings instead')
    parser.add_argument('--json', type=Path, metavar='FILE', help='write all figures there')
    args = parser.parse_args()
    results = []
    if args.stationary:
        for result in stationary(args.stationary, args.features):
            results.append(result)
            print(f'{result["outputs"]} {result["kind"]} {result["seed"]}: error {result["nmse"]:.5f}, with '
                  f'forgetting 1 {result["model_nmse"]:.5f}, ratio {result["nmse"] / result["model_nmse"]:.4f}; band '
                  f'{result["band"]:.1%} ({result["model_band"]:.1%})', flush=True)
        ratios = [result['nmse'] / result['model_nmse'] for result in results]
        print(f'{len(ratios)} recordings: ratio median {np.median(ratios):.4f}, largest {max(ratios):.4f}')
    else:
        for pair in pairs(args.data):
            for variant in args.variant:
                found = run(pair, variant, args.features)
                results += found
                print(*map(show, found), sep='\n', flush=True)
    if args.json:
        args.json.write_text(json.dumps({'command': 'bands', 'runs': results}, indent=1) + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
