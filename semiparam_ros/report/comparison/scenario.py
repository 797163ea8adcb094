"""What is compared on what (Romeres et al. 2016, section V): learn one recording, then go on with another in parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from semiparam_ros.bags.loading import LoadedBag
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.variants import VARIANTS
from semiparam_ros.errors import SemiparamError
from semiparam_ros.report.initial_window import Estimation
from semiparam_ros.settings import Settings

SEEDLESS = 'P'  # it has no random features: one run says all


@dataclass(frozen=True)
class Scenario:
    """One comparison.

    :param train: the initial window, then what is learnt online. :param test: what is predicted, in ``subsets``.
    :param subsets: (first, last + 1) rows of ``test``; each starts from the model that ``train`` left.
    """

    settings: Settings
    train: Samples
    test: Samples
    robot_description: str | None
    subsets: tuple[tuple[int, int], ...]
    variants: tuple[str, ...]
    seeds: tuple[int, ...]
    estimation: Estimation = field(default_factory=Estimation)

    def draws(self) -> list[tuple[str, int]]:
        """(variant, feature seed) of every model that is learnt."""
        return [(variant, seed) for variant in self.variants
                for seed in (self.seeds[:1] if variant == SEEDLESS else self.seeds)]


def scenario_from(settings: Settings, train: LoadedBag, test: LoadedBag, *, subsets: int = 5,
                  subset_samples: int | None = None, train_samples: int | None = None,
                  test_from: int = 0, variants: Sequence[str] = tuple(VARIANTS),
                  seeds: Sequence[int] = (0, 1, 2), estimation: Estimation | None = None) -> Scenario:
    """Check that the two recordings fit each other and are long enough.

    :param subset_samples: length of each part of ``test``; by default all of it is divided.
    :param train_samples: how much of ``train`` to use; by default all. :param test_from: first row of ``test`` to use.
    """
    _require_same_robot(train, test)
    if train_samples is not None and train_samples < 1:
        raise SemiparamError(f'{train_samples} samples of the first recording were asked for; expected at least 1.')
    learnt = train.samples[:train_samples]
    if len(learnt) <= settings.initial_samples:
        raise SemiparamError(f'the first recording has {len(learnt)} samples to learn from; expected more than the '
                             f'{settings.initial_samples} of the initial window (parameter initial.samples).')
    if not seeds:
        raise SemiparamError('the comparison has no feature seed; expected at least one.')
    split = _split(len(test.samples), test_from, subsets, subset_samples, settings.horizon_length)
    if not np.ptp(test.samples.outputs[test_from:split[-1][1]], axis=0).any():
        raise SemiparamError('every output of the second recording is constant; expected outputs that vary, for errors '
                             'are measured against their variance.')
    return Scenario(settings, learnt, test.samples, train.robot_description or test.robot_description, split,
                    tuple(variants), tuple(seeds), estimation or Estimation())


def _require_same_robot(train: LoadedBag, test: LoadedBag) -> None:
    if train.joints != test.joints:
        raise SemiparamError(f'the recordings are of different robots: one has the joints {", ".join(train.joints)}, '
                             f'the other {", ".join(test.joints)}.')
    if train.frame_id != test.frame_id:
        raise SemiparamError(f"the wrenches of the recordings are in different frames: '{train.frame_id}' and "
                             f"'{test.frame_id}'.")
    described = {bag.robot_description for bag in (train, test) if bag.robot_description}
    if len(described) > 1:
        raise SemiparamError('the recordings carry different robot descriptions; expected two of the same robot.')


def _split(total: int, begin: int, subsets: int, samples: int | None, horizon: int) -> tuple[tuple[int, int], ...]:
    if subsets < 1:
        raise SemiparamError(f'{subsets} subsets were asked for; expected at least 1.')
    if not 0 <= begin < total:
        raise SemiparamError(f'the subsets would start at sample {begin} of the {total} of the second recording.')
    available = total - begin
    length = available // subsets if samples is None else samples
    if length <= horizon:
        raise SemiparamError(f'each of {subsets} subsets of the second recording ({available} samples) has {length} '
                             f'samples; expected more than the horizon of {horizon}.')
    if length * subsets > available:
        raise SemiparamError(f'{subsets} subsets of {length} samples are more than the {available} of the second '
                             'recording.')
    return tuple((start, start + length) for start in range(begin, begin + length * subsets, length))
