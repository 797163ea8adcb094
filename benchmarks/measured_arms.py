"""Diagnoses of measured arms beside the plain least-squares model: ``python benchmarks/measured_arms.py DATA``.

DATA holds the folders ``ur3_arm``, ``panda_arm`` and ``icub_arm`` with recordings of a UR3, a Franka and an iCub. Each
row judges both models on the same samples, those that fitted neither. The last row, of two recordings in one diagnosis,
has beside it the zeros of all joints, a tilt of the base and the sensor's crosstalk: in place of the effects found, and
on top of them.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))

from semiparam_ros.cli.evaluate import load_bags
from semiparam_ros.cli.main import main
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.types import Mask
from semiparam_ros.diagnosis.data.outliers import counted_outputs
from semiparam_ros.diagnosis.data.splits import leading_split
from semiparam_ros.diagnosis.diagnose import Diagnosis, diagnose
from semiparam_ros.settings import Settings, load_params
from semiparam_ros.settings.build import build_rigid_body
from support.plain_calibration import calibrated_error, further_calibrated_error
from support.plain_model import plain_model

REPOSITORY = Path(__file__).resolve().parents[1]
UR3 = ('Base=shoulder_pan_joint,Shoulder=shoulder_lift_joint,Elbow=elbow_joint,Wrist 1=wrist_1_joint,'
       'Wrist 2=wrist_2_joint,Wrist 3=wrist_3_joint')
ICUB = """
/**:
  ros__parameters:
    joints: [r_shoulder_pitch, r_shoulder_roll, r_shoulder_yaw, r_elbow]
    sensor_frame: r_arm_ft_sensor
    wrench_convention: reaction
"""
FRANKA = [f'panda_joint{number}' for number in range(1, 8)]
EFFORTS = '/**:\n  ros__parameters:\n    outputs: effort\n'


class Case(NamedTuple):
    """What is diagnosed and what judges: blocks of the recording, its end, or another recording."""

    name: str
    body: RigidBody
    samples: Samples
    train_mask: Mask | None = None
    other: Samples | None = None
    calibrated: bool = False


class Compared(NamedTuple):
    """Held-out errors, mean over the channels, and what was found."""

    plain: float
    before: float
    after: float
    further: float | None
    seconds: float
    found: list[str]
    verdict: str


def compared(case: Case) -> Compared:
    """Both models on one case."""
    start = time.perf_counter()
    other = None if case.other is None else ('other', case.other)
    found = diagnose(case.body, case.samples, train_mask=case.train_mask, other=other)
    seconds = time.perf_counter() - start
    names = [f'{finding.effect.kind}@{finding.effect.where}' for finding in found.findings]
    plain = calibrated_error(found) if case.calibrated else float(plain_error(found).mean())
    further = further_calibrated_error(found) if case.calibrated else None
    return Compared(plain, float(found.before.nmse.mean()), float(found.after.nmse.mean()), further, seconds, names,
                    found.verdict)


def plain_error(found: Diagnosis) -> np.ndarray:
    """(n,) error of the plain model on the samples that judged the diagnosis."""
    first, other = found.first, found.elsewhere
    fitted = plain_model(first.body, first.samples, first.train_mask[:, None] & first.counted)
    if other is None:
        return fitted.nmse(first.samples, found.judged[:, None] & first.counted)
    return fitted.nmse(other.samples, other.valid[:, None] & counted_outputs(first.body, other.samples))


def cases(data: Path, folder: Path) -> Iterator[Case]:
    """Each measured arm, split in several ways."""
    (folder / 'effort.yaml').write_text(EFFORTS)
    (folder / 'icub.yaml').write_text(ICUB)
    (folder / 'franka.yaml').write_text(EFFORTS + f'    joints: [{", ".join(FRANKA)}]\n')
    ur3 = [_converted(data / 'ur3_arm' / f'{name}.bag', folder, 'effort.yaml', '--robot-description',
                      data / 'ur3_arm' / 'ur3.urdf', '--topic', '/arm=/joint_states', '--joint', UR3, '--effort-sign',
                      '-1') for name in ('id1', 'id2')]
    yield Case('UR3 id1, judged on id2', *ur3[0], other=ur3[1][1])
    yield Case('UR3 id2, judged on id1', *ur3[1], other=ur3[0][1])
    yield Case('UR3 id1, blocks', *ur3[0])
    yield Case('UR3 id2, blocks', *ur3[1])
    franka = _converted(data / 'panda_arm' / 'panda_exciting_trajectory.db3', folder, 'franka.yaml', '--joint',
                        'fer_*=panda_*', '--robot-description', data / 'panda_arm' / 'panda.urdf')
    yield Case('Franka, first 60 %', *franka, leading_split(len(franka[1]), 0.6))
    yield Case('Franka, blocks', *franka)
    icub = [_converted(data / 'icub_arm' / f'icubdyn_{name}.dat', folder, 'icub.yaml', '--columns',
                       REPOSITORY / 'config' / 'icub_table.yaml', '--robot-description',
                       data / 'icub_arm' / 'iCubGenova01.urdf') for name in ('train', 'test')]
    yield Case('iCub train, judged on test', *icub[0], other=icub[1][1])
    yield Case('iCub train, blocks', *icub[0])
    both = Samples.joined([samples for _, samples in icub])
    yield Case('iCub train and test, blocks', icub[0][0], both, calibrated=True)


def _converted(source: Path, folder: Path, params: str, *options: object) -> tuple[RigidBody, Samples]:
    bag = folder / f'{source.stem}.mcap'
    if main(['convert', str(source), str(bag), *map(str, options)]) != 0:
        raise SystemExit(1)
    settings: Settings = load_params(folder / params)
    loaded = load_bags([bag], settings)[0]
    return build_rigid_body(settings, loaded.robot_description), loaded.samples


def report(rows: Iterator[tuple[str, Compared]], command: str, path: Path | None = None) -> None:
    """One line for each case as soon as it is known, then the table; JSON to ``path``."""
    console, known = Console(width=200), []
    table = Table('case', 'plain model', 'before', 'after', 'after / plain', 'calibrated on top', 'time [s]', 'found')
    for name, row in rows:
        known.append({'case': name, **row._asdict()})
        cells = (name, f'{row.plain:.4f}', f'{row.before:.4f}', f'{row.after:.4f}', f'{row.after / row.plain:.2f}',
                 f'{row.further:.4f}' if row.further else '', f'{row.seconds:.0f}',
                 f'{row.verdict}: {", ".join(row.found)}')
        console.print(*cells, sep=' | ', highlight=False, markup=False, soft_wrap=True)
        table.add_row(*cells)
    console.print(table)
    if path:
        document = json.dumps({'command': command, 'runs': known}, indent=1)
        path.write_text(document + '\n', encoding='utf-8')


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('data', type=Path)
    parser.add_argument('--only', default='', help='cases whose names hold this')
    parser.add_argument('--json', type=Path, metavar='FILE')
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        report(((case.name, compared(case)) for case in cases(arguments.data, Path(place))
                if arguments.only in case.name), 'measured_arms', arguments.json)
