"""Command `semiparam replay`: play bags on ROS topics, paced by time or by their follower."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from semiparam_ros.cli.options import add_json_option, console, require_distinct, require_places, write_json
from semiparam_ros.errors import SemiparamError

if TYPE_CHECKING:
    from semiparam_ros.playback.options import ReplayOptions

Name = TypeVar('Name', str, str | None)

OF_FOLLOWERS = {'window': 100, 'answer_timeout': 60.0}
"""Options that say nothing without a follower, by their names in the arguments, with what they are when not given."""

HELP = 'Play bags on ROS topics: at any rate, or as fast as the estimator follows without losing a sample.'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `ros2 bag play` under their names, and ours."""
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG',
                        help='MCAP file, rosbag2 directory, .db3 file or ROS 1 .bag; several are merged by time')
    _add_pace(parser.add_argument_group('pace'))
    _add_choice(parser.add_argument_group('what is played'))
    _add_follow(parser.add_argument_group('following'))
    _add_publishing(parser.add_argument_group('publishing'))
    parser.add_argument('--disable-keyboard-controls', action='store_true', help='leave the terminal alone')
    parser.add_argument('--quiet', action='store_true', help='show no progress')
    add_json_option(parser)


def _add_pace(group: argparse._ArgumentGroup) -> None:
    group.add_argument('-r', '--rate', type=float, metavar='R', help='bag seconds a second (default 1)')
    group.add_argument('-l', '--loop', action='store_true', help='start again at the end, until stopped')
    group.add_argument('-d', '--delay', type=float, default=0.0, metavar='S', help='wait before the first message')
    group.add_argument('-p', '--start-paused', action='store_true', help='wait for the space key or ~/resume')
    group.add_argument('--order', choices=('log', 'publish', 'header'), default='log',
                       help='which time of a message it is played at (default log)')


def _add_choice(group: argparse._ArgumentGroup) -> None:
    group.add_argument('--start-offset', type=float, default=0.0, metavar='S', help='begin this long after the start')
    group.add_argument('--duration', '--playback-duration', type=float, metavar='S', help='play so much of the bag')
    group.add_argument('--until', type=float, metavar='S', help='end this long after the start of the bag')
    group.add_argument('--until-stamp', '--playback-until-sec', type=float, metavar='S',
                       help='end at this time, in seconds since the epoch')
    group.add_argument('--topics', nargs='+', default=[], metavar='TOPIC', help='only these')
    group.add_argument('-e', '--regex', metavar='RE', help='only topics that match (beside --topics)')
    group.add_argument('--exclude', '--exclude-topics', nargs='+', default=[], metavar='TOPIC', help='not these')
    group.add_argument('-x', '--exclude-regex', metavar='RE', help='not topics that match')


def _add_follow(group: argparse._ArgumentGroup) -> None:
    group.add_argument('--as-fast-as-followed', action='store_true',
                       help='ignore time: publish when the follower has answered, and account for every message; '
                            'with --rate, that is the ceiling')
    group.add_argument('--follow', nargs='+', default=[], metavar='TOPIC[=PLAYED]',
                       help='topics of answers, each with the played topic that it answers (default '
                            '/estimator/residual, answering the topic of its own type); without '
                            '--as-fast-as-followed at the pace of the bag')
    group.add_argument('--window', type=int, default=100, metavar='N', help='messages on the way at most (default 100)')
    group.add_argument('--answer-timeout', type=float, default=60.0, metavar='S',
                       help='silence that counts as the end of the follower (default 60)')
    group.add_argument('--wait-for-subscribers', nargs='?', type=int, const=1, default=0, metavar='N',
                       help='wait until N nodes subscribe (1 when no number is given)')
    group.add_argument('--wait-timeout', type=float, default=30.0, metavar='S',
                       help='how long to wait for subscribers and followers (default 30)')
    group.add_argument('--wait-for-all-acked', type=float, default=0.0, metavar='S',
                       help='at the end, wait so long until reliable subscribers have everything, and fail if not '
                       '(default: 3.5 s, and no failure; 10 s with followers)')


def _add_publishing(group: argparse._ArgumentGroup) -> None:
    group.add_argument('-m', '--remap', nargs='+', default=[], metavar='OLD:=NEW', help='publish under another name')
    group.add_argument('--restamp', action='store_true', help='header stamps become the time of publishing')
    group.add_argument('--clock', nargs='?', type=float, const=40.0, metavar='HZ',
                       help='publish the time of the bag on /clock (40 Hz when no rate is given)')
    group.add_argument('--clock-topics-all', action='store_true', help='publish /clock before every message')
    group.add_argument('--qos-profile-overrides-path', '--qos-overrides', type=Path, metavar='FILE',
                       help='YAML file: topic to QoS policies, as for ros2 bag play')


def run(args: argparse.Namespace) -> int:
    """Play, tell the account, and return 1 when a message was lost or the follower fell silent."""
    from semiparam_ros.ros.replay.session import ReplaySession

    require_places(args.json, inputs=[*args.bags, args.qos_profile_overrides_path])
    require_distinct(args.bags)
    account = ReplaySession(_options(args), console, args.ros_args).run()
    for sentence in account.sentences():
        console.print(sentence, soft_wrap=True)
    for failure in account.failures:
        console.print(f'failed: {failure}', soft_wrap=True)
    if args.json:
        write_json(args.json, account.to_dict())
    return account.exit_code


def _options(args: argparse.Namespace) -> ReplayOptions:
    from semiparam_ros.playback import options
    from semiparam_ros.playback.timeline import Cut, Selection
    follow = None
    if args.follow or args.as_fast_as_followed:
        answers = _one_each('--follow', map(options.parse_follow, args.follow or [options.DEFAULT_FOLLOW]))
        follow = options.FollowOptions(answers, args.window, args.answer_timeout)
    for name, default in OF_FOLLOWERS.items():
        if follow is None and getattr(args, name) != default:
            raise SemiparamError(f'--{name.replace("_", "-")} is for followers; expected --follow or '
                                 '--as-fast-as-followed beside it.')
    return options.ReplayOptions(
        bags=tuple(args.bags), rate=_rate(args), loop=args.loop,
        delay_s=args.delay, cut=Cut(args.start_offset, args.duration, args.until, args.until_stamp),
        selection=Selection(tuple(args.topics), args.regex, tuple(args.exclude), args.exclude_regex),
        remap=_one_each('--remap', map(options.parse_remap, args.remap)), order=args.order, restamp=args.restamp,
        clock_hz=args.clock, clock_before_each=args.clock_topics_all, paused=args.start_paused,
        keyboard=not args.disable_keyboard_controls, progress=not args.quiet,
        qos_overrides=args.qos_profile_overrides_path, wait_for_subscribers=args.wait_for_subscribers,
        wait_s=args.wait_timeout, wait_for_all_acked_s=args.wait_for_all_acked, follow=follow)


def _one_each(option: str, pairs: Iterable[tuple[str, Name]]) -> dict[str, Name]:
    """Pairs by their first topics; raises SemiparamError where one has two seconds."""
    found = dict[str, Name]()
    for topic, other in pairs:
        if found.setdefault(topic, other) != other:
            raise SemiparamError(f'{option} names {topic} with {found[topic] or "none"} and with {other or "none"}; '
                                 'expected one of them.')
    return found


def _rate(args: argparse.Namespace) -> float | None:
    """Rate of the bag, None where only the follower sets the pace."""
    if args.rate is None:
        return None if args.as_fast_as_followed else 1.0
    return float(args.rate)
