"""Rules that tie several parameters together: each a pure function that returns a full sentence, or None.

The node refuses a parameter change with them, and the offline commands a parameter file.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from semiparam_ros.core.robot.urdf import check_output_joints
from semiparam_ros.core.variants import single
from semiparam_ros.errors import SemiparamError
from semiparam_ros.settings.parameter_table import Table, shown

KINDS_OF_INPUT = 3
HYPERPARAMETERS = ('gamma', 'rho', 'tau', 'sigma', 'autocorrelation_time', 'output_scale', 'pi', 'input_mean',
                   'input_scale')
FEATURES = ('rho', 'tau', 'input_mean', 'input_scale')
NOISE = ('sigma', 'output_scale')
NEEDED = {'P': ('gamma', *NOISE), 'NP': (*FEATURES, *NOISE), 'SP': (*FEATURES, *NOISE, 'pi'),
          'SP2': (*FEATURES, *NOISE, 'pi'), 'SPK': ('gamma', *FEATURES, *NOISE)}
"""Hyperparameters that each class of variants has (DESIGN, section 2)."""


def sensor_frame_is_named(table: Table) -> str | None:
    """A wrench is measured somewhere."""
    if table.outputs == 'wrench' and not table.sensor_frame:
        return ('sensor_frame is empty; with outputs wrench it must name the link or fixed joint of the URDF that '
                'carries the sensor.')
    return None


def one_robot_description(table: Table) -> str | None:
    """Two descriptions could contradict each other."""
    if table.robot_description_file and table.robot_description:
        return 'robot_description_file and robot_description are both given; expected one of them.'
    return None


def joints_are_distinct(table: Table) -> str | None:
    """A joint is named once, and moves or is locked."""
    for name, names in (('joints', table.joints), ('locked_joints.names', table.locked_joints_names)):
        if (repeated := _repeated(names)) is not None:
            return f"{name} holds '{repeated}' twice; expected distinct joint names."
    for joint in table.joints:
        if joint in table.locked_joints_names:
            return f"joint '{joint}' is in joints and in locked_joints.names; expected it in one of them."
    return None


def output_joints_are_joints(table: Table) -> str | None:
    """Efforts are predicted of joints that move."""
    names = table.output_joints
    if names and table.outputs == 'wrench':
        return 'output_joints is given, but outputs is wrench; expected it with outputs effort alone.'
    if (repeated := _repeated(names)) is not None:
        return f"output_joints holds '{repeated}' twice; expected distinct joint names."
    try:
        check_output_joints(table.joints or names, names)
    except SemiparamError as error:
        return str(error)
    return None


def temperatures_are_distinct(table: Table) -> str | None:
    """Effects know a joint's temperature by the joint, and a sensor's because there is one."""
    names = table.temperatures
    if (repeated := _repeated(names)) is not None:
        return f"temperatures holds '{repeated}' twice; expected distinct names."
    if table.outputs == 'wrench' and len(names) > 1:
        return (f'temperatures holds {len(names)} names; with outputs wrench expected one, the frame_id of the '
                "sensor's temperature, or none.")
    return None


def locked_joints_have_positions(table: Table) -> str | None:
    """One position for each name."""
    names, positions = table.locked_joints_names, table.locked_joints_positions
    if len(names) != len(positions):
        return (f'locked_joints.names holds {len(names)} joints and locked_joints.positions {len(positions)} values; '
                'expected as many.')
    return None


def features_come_in_pairs(table: Table) -> str | None:
    """Each frequency gives a cosine and a sine."""
    if isinstance(table.features_count, int) and table.features_count % 2:
        return f'features.count is {table.features_count}; expected an even number, a cosine and a sine each.'
    return None


def shadow_variants_are_distinct(table: Table) -> str | None:
    """The same variant twice would learn the same."""
    if (repeated := _repeated(table.shadow_variants)) is not None:
        return f"shadow_variants holds '{repeated}' twice; expected distinct variants."
    return None


def hyperparameters_have_sizes(table: Table) -> str | None:
    """Scalars hold one value, the others as many as there are inputs or outputs."""
    expected: list[tuple[str, Sequence[float], int | None]] = [
        ('gamma', table.hyperparameters_gamma, 1), ('rho', table.hyperparameters_rho, 1),
        ('sigma', table.hyperparameters_sigma, 1),
        ('autocorrelation_time', table.hyperparameters_autocorrelation_time, 1),
        ('tau', table.hyperparameters_tau, _n_length_scales(table)),
        ('output_scale', table.hyperparameters_output_scale, _n_outputs(table)),
        ('input_mean', table.hyperparameters_input_mean, _n_inputs(table)),
        ('input_scale', table.hyperparameters_input_scale, _n_inputs(table))]
    for name, values, size in expected:
        if values and size is not None and len(values) != size:
            return f'hyperparameters.{name} holds {len(values)} values; expected {size}, or none to estimate them.'
    return None


def input_scaling_is_whole(table: Table) -> str | None:
    """Mean and scale belong together."""
    mean, scale = table.hyperparameters_input_mean, table.hyperparameters_input_scale
    if bool(mean) != bool(scale):
        given, missing = ('input_mean', 'input_scale') if mean else ('input_scale', 'input_mean')
        return f'hyperparameters.{given} is given without hyperparameters.{missing}; expected both or neither.'
    return None


def hyperparameters_suffice(table: Table) -> str | None:
    """Given hyperparameters replace the initial window, so they must hold all that the variant has."""
    given = {name: bool(getattr(table, f'hyperparameters_{name}')) for name in HYPERPARAMETERS}
    if not any(given.values()):
        return None
    kind = single(table.variant).partition('-')[0]
    missing = [name for name in NEEDED[kind] if not given[name]]
    if missing:
        return (f'hyperparameters.{missing[0]} is empty, but {table.variant} needs it once any is given; expected all '
                'of them, or none to estimate them.')
    return None


def given_hyperparameters_know_their_features(table: Table) -> str | None:
    """With given hyperparameters there is no initial window that could tell how many features it takes."""
    if table.features_count == 'auto' and table.hyperparameters_sigma and table.variant != 'P':
        return ('features.count is auto, but hyperparameters are given; expected the number of features that they were '
                'estimated with.')
    return None


def effects_are_known(table: Table) -> str | None:
    """Each is kind, kind@where, or either with {json}, and its kind acts on the outputs."""
    if (repeated := _repeated(table.effects)) is not None:
        return f"effects holds '{repeated}' twice; expected distinct effects."
    return next((sentence for text in table.effects if (sentence := _effect_refusal(text, table.outputs))), None)


def tools_are_bodies(table: Table) -> str | None:
    """Each can be read, and is a body that can be."""
    if not table.tools:
        return None
    from semiparam_ros.core.robot.tools import tool_from_text  # pinocchio, for who declares one

    try:
        for text in table.tools:
            tool_from_text(text)
    except SemiparamError as error:
        return str(error)
    return None


def state_file_is_a_plain_name(table: Table) -> str | None:
    """Whoever sets it can reach no other folder, no hidden file, and no checkpoint."""
    if re.fullmatch(r'(?!.*\.checkpoint\.)[A-Za-z0-9_][A-Za-z0-9_.-]{0,95}\.npz', table.state_file):
        return None
    return (f'state_file is {shown(table.state_file)}; expected a plain name such as arm.npz: at most 100 letters, '
            'digits, dots, dashes and underscores, with .npz at the end, and no name of a checkpoint '
            '(state_folder names the folder).')


RULES: tuple[Callable[[Table], str | None], ...] = (
    sensor_frame_is_named, one_robot_description, joints_are_distinct, output_joints_are_joints,
    temperatures_are_distinct, locked_joints_have_positions, features_come_in_pairs, shadow_variants_are_distinct,
    hyperparameters_have_sizes, input_scaling_is_whole, hyperparameters_suffice,
    given_hyperparameters_know_their_features, effects_are_known, tools_are_bodies, state_file_is_a_plain_name)


def broken_rule(table: Table) -> str | None:
    """The sentence of the first rule that does not hold, or None."""
    return next((sentence for rule in RULES if (sentence := rule(table)) is not None), None)


def _repeated(names: Sequence[str]) -> str | None:
    return next((name for index, name in enumerate(names) if name in names[:index]), None)


def _effect_refusal(text: str, outputs: str) -> str | None:
    from semiparam_ros.effects import effect_from_text, kinds  # only who declares an effect pays for loading them

    try:
        effect = effect_from_text(text)
    except SemiparamError as error:
        return str(error)
    if outputs not in effect.outputs:
        return f"effect '{effect.kind}' does not act on outputs {outputs}; expected one of {', '.join(kinds(outputs))}."
    return None


def _n_outputs(table: Table) -> int | None:
    return 6 if table.outputs == 'wrench' else len(table.output_joints or table.joints) or None


def _n_inputs(table: Table) -> int | None:
    return KINDS_OF_INPUT * len(table.joints) or None


def _n_length_scales(table: Table) -> int | None:
    return {'one': 1, 'kind': KINDS_OF_INPUT, 'input': _n_inputs(table)}[table.features_length_scales]
