"""Names what a recording cannot show, whatever the model: joints, outputs and masses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.robot.size import inertial_scale
from semiparam_ros.core.samples import Samples
from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.data.outliers import gaps
from semiparam_ros.diagnosis.data.recordings import own_time
from semiparam_ros.diagnosis.data.splits import evenly

MOST_GAPS_NAMED = 3


def unidentifiable(body: RigidBody, samples: Samples, config: DiagnosisConfig = DEFAULTS,
                   names: Sequence[str] = ()) -> list[str]:
    """Sentences about joints that do not move or all move as one, gaps, and bodies whose inertias do not show.

    :param names: those of the recordings, where several are one.
    """
    return (_still(body, samples, config) + _gaps(samples, names, config) + _together(samples, config)
            + _unseen(body, samples, config))


def _still(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> list[str]:
    reach = np.ptp(samples.position, axis=0)
    still = [name for name, value in zip(body.joints, reach, strict=True) if value < config.still_range]
    slow = [f'{name} ({value:.3f} {body.joint_unit(name, "rad")})'
            for name, value in zip(body.joints, reach, strict=True)
            if config.still_range <= value < config.slow_range]
    notes = []
    if still:
        notes.append(f'{listed(still)} stood still: effects of {_it(still)} cannot be seen in this recording.')
    if slow:
        notes.append(f'{listed(slow)} hardly moved: what is said of {_it(slow)} is uncertain.')
    return notes


def _together(samples: Samples, config: DiagnosisConfig) -> list[str]:
    """Joints that all follow one sine: position and velocity of that one are all directions of their motion."""
    moving = np.ptp(samples.position, axis=0) > config.slow_range
    position = samples.position[:, moving]
    sizes = np.linalg.svd((position - position.mean(axis=0)) / position.std(axis=0), compute_uv=False)
    directions, count = int(np.sum(sizes > config.direction_share * sizes.max(initial=0.0))), int(moving.sum())
    if directions > 2 or count <= directions + 1:
        return []
    how = 'one direction' if directions == 1 else f'{directions} directions'
    return [f'The {count} joints move along {how} only, as one sine for all of them would: what one joint lacks looks '
            'like what another lacks. Record motion in which each joint has frequencies of its own.']


def _gaps(samples: Samples, names: Sequence[str], config: DiagnosisConfig) -> list[str]:
    found = gaps(samples, config)
    if not found:
        return []
    longest = sorted(sorted(found, key=lambda gap: -gap.length_s)[:MOST_GAPS_NAMED])
    starts = [own_time(samples, names, gap.start_s) for gap in longest]
    places = listed([f'{gap.length_s:.2f} s from {start_s:.2f} s{of} on'
                     for gap, (start_s, of) in zip(longest, starts, strict=True)])
    count = '1 gap' if len(found) == 1 else f'{len(found)} gaps'
    which = 'the longest are' if len(found) > MOST_GAPS_NAMED else 'namely'
    return [f'The samples looked at have {count} in time, {which} {places}; those beside them are left out.']


def _unseen(body: RigidBody, samples: Samples, config: DiagnosisConfig) -> list[str]:
    names = unseen_bodies(body, samples[evenly(len(samples), config.setup_samples)], config)
    if not names:
        return []
    return [f'The motion does not show how heavy every part is: masses or centres of mass of {listed(names)} stay at '
            'the robot description, and effects that act like them cannot be seen. Move more joints, further or '
            'faster.']


def unseen_bodies(body: RigidBody, samples: Samples, config: DiagnosisConfig = DEFAULTS) -> list[str]:
    """Names of the bodies whose masses or first moments the motion does not show.

    Looks for combinations that hardly move the outputs, and names the body that has the largest part in each. Leaves
    out combinations that no motion could show. A wrench's constant offset hides what is constant.
    """
    columns = body.regressors(samples)
    if body.outputs == 'wrench':
        columns = columns - columns.mean(axis=0)
    scale = samples.outputs.std(axis=0) + 1e-12
    rows = (columns / scale[:, None]).reshape(-1, body.n_parameters) / np.sqrt(len(samples) * body.n_outputs)
    spread = inertial_scale(body).reshape(-1, 10)
    spread[:, 4:] = 0.0
    shown, size, parts = np.linalg.svd(body.basis.T * spread.ravel(), full_matrices=False)
    possible = size > config.negligible * size[0]
    seen = rows @ (shown[:, possible] * size[possible])
    _, moved, mixed = np.linalg.svd(seen, full_matrices=len(seen) < seen.shape[1])  # of 30 joints 1.8 GB otherwise
    moved = np.concatenate([moved, np.zeros(len(mixed) - len(moved))])
    dark = mixed[moved < config.unseen_share] @ parts[possible]
    share = (dark**2).reshape(len(dark), len(body.bodies), 10).sum(axis=2)
    names = _body_names(body)
    return list(dict.fromkeys(names[index] for index in share.argmax(axis=1)))


def _body_names(body: RigidBody) -> list[str]:
    """Bodies as a reader knows them: by the joint, or the sensor, that carries them."""
    names = [f'the link after {name}' for name in body.bodies]
    if body.outputs == 'wrench':
        names[0] = f'the link that {body.bodies[0]} carries'
    return names


def listed(names: Sequence[str]) -> str:
    """Names as a sentence has them."""
    return names[0] if len(names) == 1 else f'{", ".join(names[:-1])} and {names[-1]}'


def _it(names: list[str]) -> str:
    return 'it' if len(names) == 1 else 'them'
