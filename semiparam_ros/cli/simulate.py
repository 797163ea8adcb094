"""Command `semiparam simulate OUT.mcap`: a recording of an arm whose hidden causes are known."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from semiparam_ros.cli.options import add_params_option, output, require_bag_name, require_places, write_json
from semiparam_ros.core.stamps import NANOSECONDS
from semiparam_ros.errors import SemiparamError

if TYPE_CHECKING:
    from semiparam_ros.bags.writer import BagWriter
    from semiparam_ros.simulation import EffectRequest, Scenario, SimulatedRecording

HELP = 'Simulate a recording of an arm, with undeclared effects on request, and tell the truth in a file.'
DEFAULT_SAMPLES = 4000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `semiparam simulate`."""
    parser.add_argument('bag', metavar='OUT.mcap', type=Path, nargs='?', help='the recording to write')
    motion = parser.add_argument_group('motion')
    motion.add_argument('--motion', default='circle_xy', metavar='NAME',
                        help='circle_xy, circle_xz, fourier, mixed or reach (default: circle_xy)')
    length = motion.add_mutually_exclusive_group()
    length.add_argument('--samples', type=int, metavar='N', help=f'number of samples (default: {DEFAULT_SAMPLES})')
    length.add_argument('--seconds', type=float, metavar='S', help='length instead of the number of samples')
    motion.add_argument('--rate', type=float, default=20.0, metavar='HZ', help='samples a second (default: 20)')
    _add_effect_options(parser.add_argument_group('what is hidden in it'))
    _add_robot_options(parser.add_argument_group('robot'))


def _add_effect_options(group: argparse._ArgumentGroup) -> None:
    group.add_argument('--effect', action='append', default=[], metavar='KIND[@WHERE]', dest='effects',
                       help='an effect that no model declares; may be repeated; "list" lists the kinds')
    group.add_argument('--size', action='append', default=[], type=float, metavar='S', dest='sizes',
                       help='size of each effect, or one for all: 1 changes the outputs by 10 %% of their standard '
                            'deviation, RMS (default: 1)')
    group.add_argument('--start', action='append', default=[], type=float, metavar='S', dest='starts',
                       help='second at which each effect begins, or one for all')
    group.add_argument('--end', action='append', default=[], type=float, metavar='S', dest='ends',
                       help='second at which each effect is over, or one for all (default: it stays)')
    group.add_argument('--baseline', default='none', metavar='NAME',
                       help='none, or bundled: the few unmodelled effects of the bundled recordings (default: none)')
    group.add_argument('--noise', type=float, default=1.0, metavar='SCALE',
                       help='of the outputs: 1 is 2 %% of their standard deviation (default: 1)')
    group.add_argument('--encoder-noise', type=float, default=1.0, metavar='SCALE',
                       help='of positions, velocities and accelerations (default: 1)')
    group.add_argument('--no-accelerations', action='store_true', help='leave the topic joint_accelerations out')
    group.add_argument('--temperatures', action='store_true',
                       help="record those of the joints, or of a wrench's sensor, also where no effect needs them")
    group.add_argument('--truth', '--json', type=Path, metavar='FILE', dest='truth',
                       help='write what was hidden to this JSON file, in SI units')


def _add_robot_options(group: argparse._ArgumentGroup) -> None:
    add_params_option(group)  # type: ignore[arg-type]
    group.add_argument('--seed', type=int, default=0, metavar='N', help='of everything random (default: 0)')
    group.add_argument('--robot-seed', type=int, metavar='N',
                       help='of the true inertias, to meet the same robot again (default: the seed)')
    group.add_argument('--outputs', choices=('wrench', 'effort'), help='what is measured (default: wrench)')
    group.add_argument('--urdf', type=Path, metavar='FILE', help="another arm than the package's own")
    group.add_argument('--joints', nargs='+', metavar='JOINT', help='joints that move (default: all that turn)')
    group.add_argument('--sensor-frame', metavar='FRAME', help='link or fixed joint of the force/torque sensor')
    group.add_argument('--convention', choices=('action', 'reaction'),
                       help='sign of the wrench (default: reaction)')


def run(args: argparse.Namespace) -> int:
    """Simulate, write, and say what was hidden."""
    from semiparam_ros.bags.writer import partial_path
    from semiparam_ros.simulation import simulate

    if 'list' in args.effects:
        return _list_kinds(args)
    if args.bag is None:
        raise SemiparamError('the name of the recording to write is missing; expected OUT.mcap.')
    require_bag_name(args.bag)
    require_places(args.bag, partial_path(args.bag), args.truth, inputs=[args.params, args.urdf])
    recording = simulate(scenario_of(args))
    write_bag(args.bag, recording)
    if args.truth:
        write_json(args.truth, truth_of(recording))
    _report(args.bag, recording)
    return 0


def scenario_of(args: argparse.Namespace) -> Scenario:
    """The scenario that the command line describes; a parameter file gives the robot where an option does not."""
    from semiparam_ros.core.robot.urdf import parse
    from semiparam_ros.settings import load_params
    from semiparam_ros.settings.robot_description import robot_description
    from semiparam_ros.simulation import Scenario

    chosen: dict[str, Any] = {
        'outputs': args.outputs, 'joints': tuple(args.joints or ()) or None, 'sensor_frame': args.sensor_frame,
        'convention': args.convention, 'urdf': _text(args.urdf) if args.urdf else None}
    if args.params:
        settings = load_params(args.params)
        given = settings.robot_description_file or settings.robot_description
        described = robot_description(settings) if given and not args.urdf else None
        of_file = {'outputs': settings.outputs, 'joints': tuple(settings.joints) or None,
                   'sensor_frame': settings.sensor_frame or None, 'convention': settings.wrench_convention,
                   'urdf': described}
        chosen = {name: of_file[name] if value is None else value for name, value in chosen.items()}
        chosen['locked'] = tuple(zip(settings.locked_joints_names, settings.locked_joints_positions, strict=True))
    if chosen['outputs'] == 'effort' and (args.sensor_frame or args.convention):
        raise SemiparamError('--sensor-frame and --convention are those of a wrench; expected neither with outputs '
                             'effort.')
    if chosen['urdf'] is not None:
        parse(chosen['urdf'])  # what the other commands would refuse makes no recording
    return Scenario(motion=args.motion, samples=samples_of(args), rate_hz=args.rate, effects=effects_of(args),
                    seed=args.seed, robot_seed=args.robot_seed, baseline=args.baseline, noise=args.noise,
                    encoder_noise=args.encoder_noise, accelerations=not args.no_accelerations,
                    temperatures=args.temperatures,
                    **{name: value for name, value in chosen.items() if value is not None})


def samples_of(args: argparse.Namespace) -> int:
    """Number of samples to make."""
    if args.seconds is None:
        return DEFAULT_SAMPLES if args.samples is None else int(args.samples)
    if not 0 < args.seconds * args.rate < 1e9:
        raise SemiparamError(f'--seconds {args.seconds} at --rate {args.rate} gives no recording.')
    return round(args.seconds * args.rate)


def effects_of(args: argparse.Namespace) -> tuple[EffectRequest, ...]:
    """Effects with their places, sizes, starts and ends."""
    from semiparam_ros.simulation import EffectRequest

    count = len(args.effects)
    sizes, starts = _one_each('--size', args.sizes, count, 1.0), _one_each('--start', args.starts, count, None)
    ends, parts = _one_each('--end', args.ends, count, None), [text.partition('@') for text in args.effects]
    return tuple(EffectRequest(kind, where or None, size, start, end)
                 for (kind, _, where), size, start, end in zip(parts, sizes, starts, ends, strict=True))


def _one_each(option: str, values: list[float], count: int, default: float | None) -> list[Any]:
    """One value for each effect from none, one for all, or one each."""
    if len(values) not in (0, 1, count):
        raise SemiparamError(f'{option} is given {len(values)} times for {count} effects; expected one for all or one '
                             'for each.')
    if values and not count:
        raise SemiparamError(f'{option} needs an effect that it belongs to; add --effect KIND.')
    return values if len(values) == count else [values[0] if values else default] * count


def _text(path: Path) -> str:
    from semiparam_ros.settings.text_file import read_text

    try:
        return read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise SemiparamError(f'the URDF {path} cannot be read: {getattr(error, "strerror", None) or error}.') from error


def write_bag(path: Path, recording: SimulatedRecording) -> None:
    """Write the topics that a robot would publish, the robot description first."""
    from semiparam_ros.bags.conversion import write_description
    from semiparam_ros.bags.writer import BagWriter

    with BagWriter(path) as bag:
        write_description(bag, recording.urdf, int(recording.stamps[0]))
        for row, stamp in enumerate(recording.stamps.tolist()):
            write_row(bag, recording, row, stamp)


def write_row(bag: BagWriter, recording: SimulatedRecording, row: int, stamp: int) -> None:
    """Write every measurement of one sample, whose stamp is in ns."""
    from semiparam_ros.bags import sample_messages

    joints, values = recording.joint_names, recording.outputs[row].tolist()
    sample_messages.joint_state(
        bag, stamp, joints, recording.position[row].tolist(), recording.velocity[row].tolist(),
        values if recording.outputs_kind == 'effort' else ())
    if recording.temperature is not None and is_read(recording, row):
        for name, value in zip(recording.temperatures, recording.temperature[row].tolist(), strict=True):
            sample_messages.temperature(bag, stamp, name, value)
    if recording.acceleration is not None:
        sample_messages.accelerations(bag, stamp, joints, accelerations=recording.acceleration[row].tolist())
    if recording.outputs_kind == 'wrench':
        sample_messages.wrench(bag, stamp, recording.frame_id, values)


def is_read(recording: SimulatedRecording, row: int) -> bool:
    """Tell whether temperatures are read anew at a sample: once a second."""
    seconds = (recording.stamps[max(row - 1, 0):row + 1] - recording.stamps[0]) // NANOSECONDS
    return row == 0 or bool(seconds[1] > seconds[0])


def truth_of(recording: SimulatedRecording) -> dict[str, Any]:
    """Truth that a perfect diagnosis would find, for a JSON file."""
    return {'effects': list(recording.truth), 'baseline': list(recording.baseline_truth),
            'outputs': recording.outputs_kind, 'convention': recording.convention, 'frame_id': recording.frame_id,
            'joints': list(recording.joint_names), 'samples': len(recording.stamps),
            'noise_std': recording.noise_std.tolist()}


def _report(path: Path, recording: SimulatedRecording) -> None:
    from semiparam_ros.core.robot.urdf import parse, unfollowed_joints

    output.print(f'{path}: {len(recording.stamps)} samples of {", ".join(recording.joint_names)}; '
                 f'outputs {recording.outputs_kind}.', soft_wrap=True)
    loose = unfollowed_joints(parse(recording.urdf))
    if loose:
        output.print(f'  Held at zero, as no joint state follows what is floating or planar: {", ".join(loose)}.',
                     soft_wrap=True)
    for effect in (*recording.truth, *recording.baseline_truth):
        where = f' at {effect["where"]}' if effect['where'] else ''
        start = '' if effect['start_s'] is None else f' from {effect["start_s"]:.1f} s on'
        start += '' if effect['end_s'] is None else f' until {effect["end_s"]:.1f} s'
        output.print(f'  {effect["kind"]}{where}{start}: {100 * effect["rms_share"]:.1f} % of the outputs, of which '
                     f'{100 * effect["unexplained_share"]:.1f} % no rigid body explains.',
                     soft_wrap=True)


def _list_kinds(args: argparse.Namespace) -> int:
    from semiparam_ros.simulation.causes import UNLISTED_KINDS, kinds

    others = [f'--effect {effect}' for effect in args.effects if effect != 'list']
    for option, given in (('OUT.mcap', args.bag), ('--truth', args.truth), ('--params', args.params),
                          *((other, True) for other in others)):
        if given:
            raise SemiparamError(f'--effect list lists the kinds alone; expected no {option} beside it.')
    for kind in kinds(args.outputs or 'wrench'):
        output.print(kind + (' (of no listed kind)' if kind in UNLISTED_KINDS else ''))
    return 0
