"""Command `semiparam record`: the topics of a node, or any others, into a new MCAP bag."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from semiparam_ros.cli.options import add_json_option, console, require_bag_name, require_places, write_json

if TYPE_CHECKING:
    from semiparam_ros.ros.record.options import RecordOptions

HELP = "Record a node's outputs beside its inputs into a new MCAP bag, until Ctrl-C or a limit."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `semiparam record`."""
    parser.add_argument('bag', type=Path, metavar='OUT.mcap', help='the bag to write; it takes this name when complete')
    chosen = parser.add_argument_group('what is recorded')
    chosen.add_argument('--node', nargs='+', default=[], metavar='NODE',
                        help='what these nodes publish and subscribe to (default /estimator when nothing is named)')
    chosen.add_argument('--topics', nargs='+', default=[], metavar='TOPIC', help='these topics')
    chosen.add_argument('-a', '--all', action='store_true', help='every topic but /rosout and /parameter_events')
    chosen.add_argument('-e', '--regex', metavar='RE', help='of those, only topics that match')
    chosen.add_argument('--exclude', nargs='+', default=[], metavar='TOPIC', help='not these')
    chosen.add_argument('-x', '--exclude-regex', metavar='RE', help='not topics that match')
    end = parser.add_argument_group('when it ends (without these: by Ctrl-C)')
    end.add_argument('--count', metavar='[TOPIC=]N', help='after N messages, of one topic or of all together')
    end.add_argument('--until-idle', type=float, metavar='S', help='when nothing has arrived for so long')
    end.add_argument('--duration', type=float, metavar='S', help='after so long')
    parser.add_argument('--compression', choices=('zstd', 'lz4', 'none'), default='zstd',
                        help='of the bag (default zstd)')
    parser.add_argument('--overwrite', action='store_true', help='replace an older bag of that name')
    parser.add_argument('--wait-timeout', type=float, default=30.0, metavar='S',
                        help='how long to wait for the named nodes and topics (default 30)')
    parser.add_argument('--quiet', action='store_true', help='show no progress')
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Record and tell what was recorded."""
    from semiparam_ros.ros.record.session import RecordSession

    require_bag_name(args.bag)
    require_places(args.bag, args.json)
    account = RecordSession(_options(args), console, args.ros_args).run()
    console.print(account.sentence, soft_wrap=True)
    if args.json:
        write_json(args.json, account.to_dict())
    return 0


def _options(args: argparse.Namespace) -> RecordOptions:
    from semiparam_ros.playback.timeline import Selection
    from semiparam_ros.ros.record.options import DEFAULT_NODE, Limits, RecordOptions, parse_count
    count, count_topic = parse_count(args.count) if args.count else (None, None)
    named = args.node or args.topics or args.all
    return RecordOptions(
        path=args.bag, nodes=tuple(args.node) if named else (DEFAULT_NODE,), topics=tuple(args.topics),
        everything=args.all, selection=Selection((), args.regex, tuple(args.exclude), args.exclude_regex),
        limits=Limits(count, count_topic, args.until_idle, args.duration), compression=args.compression,
        wait_s=args.wait_timeout, progress=not args.quiet, overwrite=args.overwrite)
