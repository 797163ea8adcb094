"""Command `semiparam convert`: a table, a damaged bag or one of another format becomes MCAP."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from semiparam_ros.bags.array_files import holds_arrays
from semiparam_ros.bags.conversion import Edits, convert_bag, obstacle, read_description
from semiparam_ros.bags.reader import is_bag, open_bag
from semiparam_ros.bags.text_tables import (
    PER_JOINT,
    TIME_UNITS,
    TableLayout,
    convert_table,
    effort_factors,
    load_layout,
)
from semiparam_ros.bags.writer import BagWriter, partial_path
from semiparam_ros.cli.options import console, progress_bar, require_bag_name, require_places
from semiparam_ros.errors import SemiparamError

HELP = 'Convert a table (text, .npz, .mat) or a bag (ROS 1, rosbag2, damaged MCAP) to an MCAP bag.'

_TABLE_OPTIONS = ('joints', 'temperatures', 'degrees', 'period', 'rate', 'start', 'time_unit')
_BOTH_OPTIONS = ('wrench_frame', 'wrench_sign', 'effort_sign', 'effort_factors')
_WITHOUT_TIME = ('rate', 'period', 'start')
_OF_ROLE = {'time_unit': 'time', 'temperatures': 'temperature', 'effort_sign': 'effort', 'wrench_sign': 'force',
            'wrench_frame': 'force'}
"""Options that say nothing without columns of a role."""
_ROLES = ('time', *PER_JOINT, 'force', 'torque', 'temperature')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Positional files, then what concerns tables, bags, and both."""
    parser.add_argument('input', metavar='INPUT', type=Path,
                        help='text table, .npz, .npy or .mat file, folder with a text table for each quantity, .mcap '
                        'file, rosbag2 directory, .db3 file or ROS 1 .bag')
    parser.add_argument('output', metavar='OUTPUT.mcap', type=Path, help='the MCAP bag that is written')
    parser.add_argument('--robot-description', metavar='URDF', type=Path,
                        help='URDF file that travels in the bag as the latched /robot_description')
    parser.add_argument('--effort-sign', type=float, metavar='SIGN', help='multiplies joint efforts: 1 or -1')
    parser.add_argument('--effort-factors', metavar='JOINT=FACTOR,...',
                        help='multiplies the efforts of single joints: N m for an ampere, or -1')
    parser.add_argument('--wrench-sign', type=float, metavar='SIGN', help='multiplies wrenches: 1 or -1')
    parser.add_argument('--wrench-frame', metavar='FRAME', help='frame_id of the wrenches')
    _add_table_arguments(parser.add_argument_group(
        'tables', 'COLUMNS are numbers from 1 (1-4, or 1,3,5) or names: of the header line, of arrays (STRUCT.FIELD '
        'in a struct), or of the files of a folder; NAME:2 is the second column of an array. Options win over the '
        '--columns file, which holds joints, temperatures, columns, degrees, sliding (joints), period (or rate), '
        'start, time_unit, wrench_frame, wrench_sign, effort_sign, effort_factors (a mapping).'))
    bags = parser.add_argument_group('bags')
    bags.add_argument('--topic', metavar='TOPIC[=NEW]', action='append', default=[],
                      help='take this topic alone, under its new name if one is given; may be repeated')
    bags.add_argument('--joint', metavar='NAME=NEW[,...]', action='append', default=[],
                      help="rename a joint; 'fer_*=panda_*' renames all that fit; may be repeated")
    bags.add_argument('--stamps-from-log', action='store_true',
                      help='put the time of recording into the headers, for bags whose headers hold no time')


def _add_table_arguments(group: Any) -> None:
    group.add_argument('--columns', metavar='FILE', type=Path, help='YAML file that says what the columns mean')
    group.add_argument('--joints', metavar='NAME,...', help='names of the joints, in the order of their columns')
    group.add_argument('--temperatures', metavar='NAME,...',
                       help='joints, or the frame of the sensor, whose temperatures there are, in the order of their '
                            'columns')
    for role in _ROLES:
        group.add_argument(f'--{role}', metavar='COLUMNS', help=f'columns of the {role}')
    angles = group.add_mutually_exclusive_group()
    angles.add_argument('--degrees', action='store_const', const=True, dest='degrees',
                        help='angles are in degrees; joints that slide by --robot-description have none')
    angles.add_argument('--radians', action='store_const', const=False, dest='degrees', help='angles are in radians')
    steps = group.add_mutually_exclusive_group()
    steps.add_argument('--rate', type=float, metavar='HZ', help='rows per second, where no column holds the time')
    steps.add_argument('--period', type=float, metavar='SECONDS', help='time from row to row, likewise')
    group.add_argument('--start', type=float, metavar='SECONDS', help='stamp of the first row, likewise (default 1)')
    group.add_argument('--time-unit', choices=tuple(TIME_UNITS), help='unit of the time column (default s)')


def run(args: argparse.Namespace) -> int:
    """Convert, and say on standard error what came out."""
    require_bag_name(args.output)
    for sign in ('effort_sign', 'wrench_sign'):
        value = 1.0 if getattr(args, sign) is None else getattr(args, sign)
        if abs(value) != 1.0:
            expected = '1 or -1' if math.isfinite(value) else 'a finite number, 1 or -1'
            raise SemiparamError(f'--{sign.replace("_", "-")} is {value:g}; expected {expected}.')
    require_places(args.output, partial_path(args.output),
                   inputs=[args.input, args.columns, args.robot_description])
    description = read_description(args.robot_description) if args.robot_description else None
    table = holds_arrays(args.input) or not is_bag(args.input)
    lines = _from_bag(args, description) if not table else _from_table(args, description)
    for line in lines:
        console.print(line, soft_wrap=True)
    return 0


def _from_table(args: argparse.Namespace, description: str | None) -> list[str]:
    _refuse(args, ('topic', 'joint', 'stamps_from_log'), 'bags', 'a text table')
    layout = table_layout(args)
    with BagWriter(args.output) as bag, progress_bar() as bar:
        task = bar.add_task('bytes', total=args.input.stat().st_size)
        summary = convert_table(args.input, layout, bag, description, lambda done: bar.update(task, completed=done))
    duration = (summary.end_ns - summary.start_ns) * 1e-9
    lines = [f'{args.output}: {summary.rows} rows, {duration:.3f} s.']
    if summary.not_finite:
        lines.append(f'{summary.not_finite} rows hold a number that is not finite.')
    if summary.not_increasing:
        lines.append(f'{summary.not_increasing} rows are not later than the row before.')
    return lines


def table_layout(args: argparse.Namespace) -> TableLayout:
    """The --columns file with what the command line puts in its place."""
    layout = load_layout(args.columns) if args.columns else TableLayout()
    values = {name: getattr(args, name) for name in (*_TABLE_OPTIONS, *_BOTH_OPTIONS)
              if getattr(args, name) is not None}
    values['columns'] = {role: getattr(args, role) for role in _ROLES if getattr(args, role) is not None}
    merged = layout.merged(values, 'command line')
    for name in _WITHOUT_TIME:
        if name in values and 'time' in merged.columns:
            raise SemiparamError(f'--{name} is for tables without a column of the time; that of this one is named.')
    for name, role in _OF_ROLE.items():
        if name in values and role not in merged.columns:
            raise SemiparamError(f'--{name.replace("_", "-")} needs columns of the {role}; expected --{role} COLUMNS.')
    return merged


def _from_bag(args: argparse.Namespace, description: str | None) -> list[str]:
    _refuse(args, ('columns', *_TABLE_OPTIONS, *_ROLES), 'text tables', 'a bag')
    edits = Edits(_pairs(args.topic, optional=True), _pairs([part for text in args.joint for part in text.split(',')]),
                  1.0 if args.effort_sign is None else args.effort_sign,
                  {} if args.effort_factors is None else effort_factors(args.effort_factors, 'command line'),
                  1.0 if args.wrench_sign is None else args.wrench_sign, args.wrench_frame or '', args.stamps_from_log)
    with open_bag(args.input) as source, BagWriter(args.output) as bag, progress_bar() as bar:
        task = bar.add_task('messages', total=sum(info.count for topic, info in source.topics.items()
                                                  if not edits.topics or topic in edits.topics))
        counts = convert_bag(source, edits, bag, description, lambda done: bar.update(task, completed=done))
        losses = source.losses
        others = {topic: reason for topic, info in source.topics.items() if (reason := obstacle(info))}
    chosen = ', '.join(f'{count} on {edits.topics.get(topic, topic)}' for topic, count in counts.items())
    left = [f'{topic} is left out: {reason}.' for topic, reason in others.items()]
    return [f'{args.output}: {chosen or "no messages"}.', *left, *([losses.sentence] if losses else [])]


def _pairs(texts: Sequence[str], optional: bool = False) -> dict[str, str]:
    """Dictionary of 'OLD=NEW' texts; with ``optional`` a lone 'OLD' keeps its name."""
    pairs = dict[str, str]()
    for text in texts:
        old, equals, new = (part.strip() for part in text.partition('='))
        if not old or bool(equals) is not bool(new) or not (new or optional):
            raise SemiparamError(f'{text!r} is no renaming; expected OLD=NEW.')
        if pairs.setdefault(old, new or old) != (new or old):
            raise SemiparamError(f'{old!r} is to become {pairs[old]!r} and {new or old!r}; expected one name.')
    return pairs


def _refuse(args: argparse.Namespace, names: Sequence[str], meant_for: str, given: str) -> None:
    """An option that could do nothing is a mistake that should not go unnoticed."""
    for name in names:
        if getattr(args, name) not in (None, [], False):
            raise SemiparamError(f'--{name.replace("_", "-")} is for {meant_for}, but {str(args.input)!r} is {given}.')
