"""Command `semiparam export SOURCE`: what was learnt as files for controllers and simulators."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from semiparam_ros.atomic_write import write_text
from semiparam_ros.cli import options
from semiparam_ros.errors import SemiparamError

if TYPE_CHECKING:
    from semiparam_ros.core.robot.rigid_body import RigidBody
    from semiparam_ros.core.samples import Samples
    from semiparam_ros.effects import Effect
    from semiparam_ros.export.estimate import Estimate
    from semiparam_ros.export.identified import Identified
    from semiparam_ros.settings import Settings

HELP = ('Write what was learnt, as bodies that can exist, into a URDF, a MuJoCo model, and forms '
        'of controllers.')

FORMS = {'urdf': 'URDF: inertias, friction and damping, loads as fixed links; all else as it was',
         'mjcf': 'MuJoCo model: the same, with armature; needs the Python package mujoco',
         'ur-payload': 'load as URScript set_target_payload (Universal Robots)',
         'franka-desk': 'load as the JSON file of an end effector in Franka Desk',
         'libfranka': 'load as a call of franka::Robot::setLoad',
         'gravity-filter': 'weight on the sensor, for the gravity compensation of ros2_control',
         'crisp-friction': 'friction of the joints, for crisp_controllers'}

AT_FLANGE = ('ur-payload', 'franka-desk', 'libfranka')
"""Those that tell a load in the frame of ``--flange``."""

MOST_SAMPLES = 60_000
"""Number of samples beyond which evenly spread stretches of a recording are read."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `semiparam export`."""
    parser.add_argument('source', metavar='SOURCE', type=Path,
                        help='recording (.mcap, rosbag2 directory, .db3, ROS 1 .bag), or a saved '
                        'state (.npz)')
    options.add_params_option(parser)
    parser.add_argument('--load', metavar='LINK', action='append', default=[],
                        help='this link carries a load that the description lacks; may be '
                        'repeated. A payload among the effects of the parameters is one too')
    parser.add_argument('--keep-inertias', action='store_true',
                        help='links stay as described, so that loads explain what differs')
    parser.add_argument('--kept-samples', action='store_true',
                        help='of a state, fit the samples that it keeps, smoothed as those of a '
                        'recording: sharper than what was learnt one by one, where the robot did '
                        'not change meanwhile')
    parser.add_argument('--flange', metavar='LINK',
                        help="link in whose frame controllers' loads are told (default: the one "
                        'that carries the load)')
    files = parser.add_argument_group('files')
    for form, text in FORMS.items():
        files.add_argument(f'--{form}', metavar='FILE', type=Path, help=text)
    options.add_json_option(files)  # type: ignore[arg-type]


def run(args: argparse.Namespace) -> int:
    """Identify, write every file that was asked for, and show what was found."""
    from semiparam_ros.export.identified import identify
    from semiparam_ros.export.report import document, lines, price
    from semiparam_ros.export.urdf import described_links
    from semiparam_ros.settings import load_params
    from semiparam_ros.settings.robot_description import resolved

    paths: dict[str, Path | None] = {form: getattr(args, form.replace('-', '_')) for form in FORMS}
    if args.flange and not any(paths[form] for form in AT_FLANGE):
        raise SemiparamError(f'--flange {args.flange} tells where a load is told to a controller, but no file for one '
                             f'is asked for; expected --{", --".join(AT_FLANGE)} FILE.')
    options.require_places(args.json, *paths.values(), inputs=[args.source, args.params])
    settings = load_params(args.params)
    if settings.robot_description_file:
        options.require_places(args.json, *paths.values(), inputs=[resolved(settings.robot_description_file)])
    texts = [f'payload@{link}' for link in args.load]
    settings = replace(settings, effects=(*settings.effects, *texts))
    estimate, urdf = _estimate(args, settings)
    found = identify(estimate, described_links(urdf), args.keep_inertias)
    body = estimate.columns.body
    written = {path: _text(form, body, urdf, found, args.flange, settings.tools)
               for form, path in paths.items() if path}
    for path, text in written.items():
        write_text(path, text)
    if args.json:
        options.write_json(args.json, {'command': 'export', 'source': str(args.source),
                                       **document(found)})
    for line in [*lines(found), price(found)]:
        options.tell(line)
    for path in filter(None, (*written, args.json)):
        options.tell(f'written: {path}')
    return 0


def _estimate(args: argparse.Namespace, settings: Settings) -> tuple[Estimate, str]:
    """Estimate that the source gives, and the robot description."""
    from semiparam_ros.settings.robot_description import robot_description

    source = args.source
    if source.suffix in ('.yaml', '.yml'):
        raise SemiparamError(f'{source} says what there is, not how much of it; expected a '
                             f'recording or a saved state, and this file as --params {source}.')
    if source.suffix == '.npz':
        if (args.load or args.keep_inertias) and not args.kept_samples:
            raise SemiparamError(f'--load and --keep-inertias ask for a fit, but {source} is a '
                                 'saved state; expected --kept-samples too, a recording, or a '
                                 'payload among the effects that the state has learnt.')
        return _of_state(args, settings), robot_description(settings)
    if args.kept_samples:
        raise SemiparamError(f'{source} is a recording; --kept-samples expects a saved state (.npz).')
    return _of_recording(args, settings)


def _of_state(args: argparse.Namespace, settings: Settings) -> Estimate:
    from semiparam_ros.export.estimate import from_estimator, from_recording, with_known
    from semiparam_ros.online.applied_effects import AppliedEffects
    from semiparam_ros.online.state_file import load
    from semiparam_ros.settings.build import build_rigid_body, declared_effects

    body = build_rigid_body(settings)
    saved = load(args.source, settings, body)
    changes = AppliedEffects(body)
    changes.restore(saved.applied)
    samples = saved.batch.samples
    options.remark(body)
    _require_right_setup(args, body, samples, declared_effects(saved.settings))
    if args.kept_samples and samples is not None:
        texts = *saved.settings.effects, *(f'payload@{link}' for link in args.load)
        effects = declared_effects(replace(saved.settings, effects=texts))
        estimate = from_recording(body, effects, samples, saved.settings.joint_friction,
                                  args.keep_inertias, str(args.source))
    else:
        estimate = from_estimator(saved.estimator, samples, str(args.source))
    return with_known(estimate, changes.applied)._replace(bias=saved.bias)


def _of_recording(args: argparse.Namespace, settings: Settings) -> tuple[Estimate, str]:
    from semiparam_ros.cli.evaluate import load_bags
    from semiparam_ros.export.estimate import from_recording
    from semiparam_ros.settings.build import build_rigid_body, declared_effects
    from semiparam_ros.settings.robot_description import robot_description

    bag = load_bags([args.source], settings, lambda rate: MOST_SAMPLES)[0]
    body = build_rigid_body(settings, bag.robot_description)
    options.remark(body)
    effects = declared_effects(settings)
    _require_right_setup(args, body, bag.samples, effects)
    estimate = from_recording(body, effects, bag.samples,
                              settings.joint_friction, args.keep_inertias, str(args.source))
    return estimate, robot_description(settings, bag.robot_description)


def _require_right_setup(args: argparse.Namespace, body: RigidBody, samples: Samples | None,
                         effects: Sequence[Effect]) -> None:
    """Refuse files that this robot cannot fill, and samples of which a diagnosis would say that a
    sign, a unit, an order or a clock is wrong: bodies that explain them are no robot's."""
    from semiparam_ros.diagnosis.setup.checks import NO_MATCH, setup_problems
    from semiparam_ros.export.controllers import require_possible

    for form in FORMS:
        if getattr(args, form.replace('-', '_')):
            require_possible(form, body)
    for problem in setup_problems(body, samples, effects=effects) if samples else ():
        if problem.what != NO_MATCH:
            raise SemiparamError(f'{args.source}: {problem.sentence}')


def _text(form: str, body: RigidBody, urdf: str, found: Identified, flange: str | None, tools: Sequence[str]) -> str:
    """Text of a file of one form."""
    from semiparam_ros.export import controllers
    from semiparam_ros.export.mjcf import identified_mjcf
    from semiparam_ros.export.report import remark
    from semiparam_ros.export.urdf import identified_urdf

    heading = remark(found)
    texts: dict[str, Callable[[], str]] = {
        'urdf': lambda: identified_urdf(urdf, found, heading),
        'mjcf': lambda: identified_mjcf(identified_urdf(urdf, found, heading), found, heading),
        'ur-payload': lambda: controllers.ur_script(controllers.load_at(body, found, flange), heading),
        'franka-desk': lambda: controllers.franka_desk(controllers.load_at(body, found, flange)),
        'libfranka': lambda: controllers.libfranka(controllers.load_at(body, found, flange), heading),
        'gravity-filter': lambda: controllers.gravity_filter(body, found, heading, tools),
        'crisp-friction': lambda: controllers.crisp_friction(found, heading)}
    return texts[form]()
