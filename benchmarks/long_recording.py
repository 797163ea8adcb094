"""A diagnosis of a long recording: time, memory, and whether what was hidden is found.

    python benchmarks/long_recording.py long.mcap                 one hour at 500 Hz, 1.8 million samples
    python benchmarks/long_recording.py long.mcap --minutes 5

Makes the recording where the file is not there yet (3 GB of memory for an hour): efforts of the package's iCub arm,
with viscous friction in one joint all along and a load from the middle on. Then `semiparam diagnose` runs as a process
of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from semiparam_ros.bags.recording_layout import JOINT_STATES, ROBOT_DESCRIPTION, TYPES
from semiparam_ros.bags.writer import BagWriter
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate

RATE_HZ = 500.0


def write(path: Path, minutes: float) -> None:
    """Circles, sums of sines and reaching in turn, which never repeat; the load is in the second half."""
    made = simulate(Scenario(
        motion='mixed', samples=round(60.0 * minutes * RATE_HZ), rate_hz=RATE_HZ, outputs='effort', accelerations=False,
        effects=(EffectRequest('viscous_friction', 'r_elbow', 1.0),
                 EffectRequest('payload', 'r_hand', 1.0, start_s=30.0 * minutes))))
    names = list(made.joint_names)
    with BagWriter(path) as bag:
        bag.write(ROBOT_DESCRIPTION, TYPES[ROBOT_DESCRIPTION], {'data': made.urdf}, int(made.stamps[0]))
        for stamp, *rows in zip(made.stamps.tolist(), made.position, made.velocity, made.outputs, strict=True):
            seconds, nanoseconds = divmod(stamp, 10**9)
            header = {'stamp': {'sec': seconds, 'nanosec': nanoseconds}, 'frame_id': ''}
            bag.write(JOINT_STATES, TYPES[JOINT_STATES], dict(zip(
                ('header', 'name', 'position', 'velocity', 'effort'),
                (header, names, *(row.tolist() for row in rows)), strict=True)), stamp)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('bag', type=Path)
    parser.add_argument('--minutes', type=float, default=60.0)
    args = parser.parse_args()
    if not args.bag.exists():
        write(args.bag, args.minutes)
    with tempfile.TemporaryDirectory() as folder:
        params, report = Path(folder, 'p.yaml'), Path(folder, 'r.json')
        params.write_text('/**:\n  ros__parameters:\n    outputs: effort\n', encoding='utf-8')
        start = time.perf_counter()
        subprocess.run([sys.executable, '-m', 'semiparam_ros.cli.main', 'diagnose', str(args.bag), '--params',
                        str(params), '--json', str(report)], check=True)
        wall = time.perf_counter() - start
        found = json.loads(report.read_text(encoding='utf-8'))
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f'{wall:.0f} s ({used.ru_utime + used.ru_stime:.0f} s of one processor), {used.ru_maxrss / 1e6:.2f} GB at '
          f'most; found {[(effect["kind"], effect["where"], effect["start_s"]) for effect in found["effects"]]}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
