"""What cannot be told from a recording, whatever the model: said by name, in plain words."""

from __future__ import annotations

import numpy as np

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.diagnosis.data.outliers import gaps
from semiparam_ros.diagnosis.setup.prior_misfit import inertial_spread

LEAST_SAMPLES = 200
STILL, LITTLE = 0.002, 0.05
"""Joints that move less than this in all [rad, or m] stand still, or hardly move."""
MOST_GAPS_NAMED = 3
USED = 500
UNSEEN = 5e-4
"""A change of a mass or a first moment as large as it is moves the outputs by less than this share of their standard
deviation: it cannot be seen. Rich motions of the iCub, UR3 and Franka arms show every one of them by 1e-3 or more; with
a joint locked that gravity needs, the least falls below 1e-5."""
NEGLIGIBLE = 1e-6


def unidentifiable(body: RigidBody, samples: Samples) -> list[str]:
    """Sentences about joints that do not move, gaps, too short recordings, and bodies whose inertias do not show."""
    notes = _short(samples) + _still(body, samples) + _dead(body, samples) + _gaps(samples)
    return notes + _unseen(body, samples) if len(samples) > 1 else notes


def _short(samples: Samples) -> list[str]:
    count = len(samples)
    return [f'The recording holds {count} samples; below {LEAST_SAMPLES} hardly any effect can be told from '
            'noise.'] if count < LEAST_SAMPLES else []


def _still(body: RigidBody, samples: Samples) -> list[str]:
    reach = np.ptp(samples.position, axis=0) if len(samples) else np.zeros(body.n_joints)
    still = [name for name, value in zip(body.joints, reach, strict=True) if value < STILL]
    slow = [f'{name} ({value:.3f} rad)' for name, value in zip(body.joints, reach, strict=True)
            if STILL <= value < LITTLE]
    notes = []
    if still:
        notes.append(f'{_listed(still)} stood still: effects of {_it(still)} cannot be seen in this recording.')
    if slow:
        notes.append(f'{_listed(slow)} hardly moved: what is said of {_it(slow)} is uncertain.')
    return notes


def _dead(body: RigidBody, samples: Samples) -> list[str]:
    """Outputs that never change."""
    if len(samples) < 2:
        return []
    reach = np.ptp(samples.outputs, axis=0)
    dead = [name for name, value in zip(body.output_names, reach, strict=True) if value == 0.0]
    return [f'No change was measured in {_listed(dead)}: what acts there cannot be seen.'] if dead else []


def _gaps(samples: Samples) -> list[str]:
    found = gaps(samples)
    if not found:
        return []
    longest = sorted(sorted(found, key=lambda gap: -gap.length_s)[:MOST_GAPS_NAMED])
    places = _listed([f'{gap.length_s:.2f} s from {gap.start_s:.2f} s on' for gap in longest])
    count = '1 gap' if len(found) == 1 else f'{len(found)} gaps'
    which = 'the longest are' if len(found) > MOST_GAPS_NAMED else 'namely'
    return [f'The recording has {count} in time, {which} {places}; the samples beside them are left out.']


def _unseen(body: RigidBody, samples: Samples) -> list[str]:
    names = unseen_bodies(body, samples[np.unique(np.linspace(0, len(samples) - 1, USED).astype(int))])
    if not names:
        return []
    return [f'The motion does not show how heavy every part is: masses or centres of mass of {_listed(names)} stay at '
            'the robot description, and effects that act like them cannot be seen. Move more joints through more '
            'of their range.']


def unseen_bodies(body: RigidBody, samples: Samples) -> list[str]:
    """Bodies that hold most of a direction of masses and first moments which hardly moves the outputs.

    Only combinations that some motion could show are looked at; a wrench's constant offset hides what is constant.
    """
    columns = body.regressors(samples)
    if body.outputs == 'wrench':
        columns = columns - columns.mean(axis=0)
    scale = samples.outputs.std(axis=0) + 1e-12
    rows = (columns / scale[:, None]).reshape(-1, body.n_parameters) / np.sqrt(len(samples) * body.n_outputs)
    spread = inertial_spread(body).reshape(-1, 10)
    spread[:, 4:] = 0.0
    shown, size, parts = np.linalg.svd(body.basis.T * spread.ravel(), full_matrices=False)
    possible = size > NEGLIGIBLE * size[0]
    _, moved, mixed = np.linalg.svd(rows @ (shown[:, possible] * size[possible]))
    moved = np.concatenate([moved, np.zeros(len(mixed) - len(moved))])
    dark = mixed[moved < UNSEEN] @ parts[possible]
    share = (dark**2).reshape(len(dark), len(body.bodies), 10).sum(axis=2)
    names = _body_names(body)
    return list(dict.fromkeys(names[index] for index in share.argmax(axis=1)))


def _body_names(body: RigidBody) -> list[str]:
    """Bodies as a reader knows them: by the joint, or the sensor, that carries them."""
    names = [f'the link after {name}' for name in body.bodies]
    if body.outputs == 'wrench':
        names[0] = f'the link that {body.bodies[0]} carries'
    return names


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f'{", ".join(names[:-1])} and {names[-1]}'


def _it(names: list[str]) -> str:
    return 'it' if len(names) == 1 else 'them'
