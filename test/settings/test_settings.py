"""The table of parameters, its rules, parameter files, and what is made from it."""

import os
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from semiparam_ros.errors import SemiparamError
from semiparam_ros.ros.estimator.process import parameter_files
from semiparam_ros.settings import PARAMETERS, Settings, dump_params, load_params
from semiparam_ros.settings.build import build_estimator, given_hyperparameters, hyperparameter_values
from semiparam_ros.settings.files import located, params_text, read_params
from semiparam_ros.settings.last_word import last_words
from semiparam_ros.settings.parameter_table import BY_NAME, Parameter
from semiparam_ros.settings.robot_description import robot_description
from semiparam_ros.settings.rules import RULES, broken_rule
from semiparam_ros.settings.snapshot import refusal
from support.node_helpers import URDF

WRENCH = Settings(sensor_frame='ft')


def write(path, text):
    path.write_text(text)
    return path


def test_the_snapshot_cannot_change():
    with pytest.raises(FrozenInstanceError):
        WRENCH.variant = 'P'


def test_every_row_accepts_its_own_default():
    assert len({parameter.name for parameter in PARAMETERS}) == len(PARAMETERS) == len(fields(Settings))
    for parameter in PARAMETERS:
        assert parameter.refusal(parameter.default) is None
        assert parameter.description.endswith('.')


def test_a_file_written_is_read_back(tmp_path):
    settings = WRENCH.changed({'variant': 'P', 'effects': ['payload{"start_s": 1.5}', 'time_delay'],
                               'hyperparameters.gamma': [1e-7], 'hyperparameters.sigma': [0.1],
                               'hyperparameters.output_scale': [1.0] * 6, 'external_wrench.frame': "it's: here"})
    dump_params(settings, tmp_path / 'p.yaml')
    assert load_params(tmp_path / 'p.yaml') == settings
    assert [path.name for path in tmp_path.iterdir()] == ['p.yaml']


@given(st.dictionaries(st.sampled_from([p.name for p in PARAMETERS if p.kind == 'double' and (p.minimum or 0) < 0.6]),
                       st.floats(0.6, 1.0)), st.text('aé%: #"\\\'', max_size=8))
def test_any_value_survives_a_file(tmp_path_factory, doubles, text):
    path = tmp_path_factory.mktemp('params') / 'p.yaml'
    settings = WRENCH.changed({**doubles, 'external_wrench.frame': text})
    dump_params(settings, path)
    assert load_params(path) == settings


@pytest.mark.parametrize('word', ['y', 'N', 'on', '1e1', '1.5e3', '.5e1', '08', '7', 'nan', '-Inf'])
def test_a_word_is_a_text_in_quotes_alone_as_in_ros(tmp_path, word):
    """rcl takes each of them for a number or a truth without quotes, and refuses a list of them among texts."""
    path, settings = tmp_path / 'p.yaml', WRENCH.changed({'joints': ['x', word], 'external_wrench.frame': word})
    dump_params(settings, path)
    assert load_params(path) == settings
    write(path, f'estimator: {{ros__parameters: {{sensor_frame: ft, joints: [x, {word}]}}}}')
    with pytest.raises(SemiparamError, match="joints mixes types in one list, which ROS refuses; write 'y', not y"):
        load_params(path)


@pytest.mark.parametrize('number', ['1.5e3', '1500', '.15e4', '1.5E+3', '15.e2'])
def test_a_number_is_read_in_every_spelling_that_ros_reads(tmp_path, number):
    text = f'estimator: {{ros__parameters: {{sensor_frame: ft, gate.timeout: {number}}}}}'
    path = write(tmp_path / 'p.yaml', text)
    assert load_params(path).gate_timeout == 1500.0


def test_unknown_name_is_answered_with_the_nearest_and_the_file(tmp_path):
    path = write(tmp_path / 'p.yaml', 'estimator: {ros__parameters: {sensor_frame: ft, features: {cuont: 200}}}')
    with pytest.raises(SemiparamError, match=r"p.yaml: there is no parameter 'features.cuont'.*'features.count'"):
        load_params(path)


@pytest.mark.parametrize(('text', 'sentence'), [
    ('estimator: {ros__parameters: {features: {count: many}}}', "features.count is 'many'; expected an integer"),
    ('estimator: {ros__parameters: {features: {count: true}}}', 'expected an integer'),
    ('estimator: {ros__parameters: {variant: SPK}}', "variant is 'SPK'; expected one of P, NP-ML"),
    ('estimator: {ros__parameters: {forgetting: 1.5}}', 'forgetting is 1.5; expected 0.5 to 1.'),
    ('estimator: {ros__parameters: {forgetting: .nan}}', 'forgetting is nan'),
    ('estimator: {ros__parameters: {joints: shoulder}}', "joints is 'shoulder'; expected a list of texts"),
    ('estimator: {ros__parameters: {hyperparameters: {tau: [1.0, 2]}}}', 'mixes types'),
    ('estimator: {ros__parameters: [1, 2]}', "holds no 'ros__parameters:'"),
    ('other: {ros__parameters: {variant: P}}', 'ROS gives no section to the node estimator \\(found: other\\)'),
    ('estimator: [', 'not valid YAML in line 1'),
    ('a: &a {x: *a}', 'not valid YAML in line 1: found unconstructable recursive node'),  # a RecursionError
    ('[' * 5000, 'is nested too deep'),
    ('', 'holds no parameters'),
])
def test_bad_files_get_one_sentence(tmp_path, text, sentence):
    path = write(tmp_path / 'p.yaml', text)
    with pytest.raises(SemiparamError, match=sentence) as error:
        load_params(path)
    assert str(path) in str(error.value)
    assert '\n' not in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SemiparamError, match=r'cannot read the parameter file .*none.yaml: No such file'):
        load_params(tmp_path / 'none.yaml')


def test_a_file_without_end_is_refused():
    with pytest.raises(SemiparamError, match='cannot read the parameter file /dev/zero: it has more than 16777216'):
        load_params('/dev/zero')
    with pytest.raises(SemiparamError, match='cannot read /dev/zero: it has more than 16777216 characters'):
        robot_description(Settings(robot_description_file='/dev/zero'))


def test_sections_apply_in_order_and_wildcards_may_hold_foreign_names(tmp_path):
    path = write(tmp_path / 'p.yaml', """
/**: {ros__parameters: {use_sim_time: true, publish_frequency: 3.0, sensor_frame: ft, variant: P}}
estimator: {ros__parameters: {variant: SP-ML, qos_overrides./wrench.subscription.depth: 5}}
/other: {ros__parameters: {variant: NP-ML}}
/right/arm: {ros__parameters: {variant: P}}
/left/arm: {ros__parameters: {variant: NP-ML}}
""")
    assert load_params(path).variant == 'SP-ML'
    assert load_params(path, node='/left/arm').variant == 'NP-ML'
    write(path, '/**: {ros__parameters: {sensor_frmae: ft}}')
    with pytest.raises(SemiparamError, match="'sensor_frame'"):
        load_params(path)


def test_numbers_are_read_as_ros_reads_them(tmp_path):
    path = write(tmp_path / 'p.yaml', 'estimator: {ros__parameters: {sensor_frame: ft, forgetting: 1, '
                                      'alignment.tolerance: 1e-3, effects: [""], joints: []}}')
    settings = load_params(path)
    assert (settings.forgetting, settings.alignment_tolerance) == (1.0, 0.001)
    assert isinstance(settings.forgetting, float)
    assert settings.effects == settings.joints == ()


BROKEN = {
    'sensor_frame_is_named': {'sensor_frame': '', 'outputs': 'wrench'},
    'one_robot_description': {'robot_description': '<robot/>', 'robot_description_file': 'a.urdf'},
    'joints_are_distinct': {'joints': ['a', 'a']},
    'output_joints_are_joints': {'output_joints': ['a']},
    'temperatures_are_distinct': {'temperatures': ['ft', 'other']},
    'locked_joints_have_positions': {'locked_joints.names': ['a']},
    'features_come_in_pairs': {'features.count': 3},
    'shadow_variants_are_distinct': {'shadow_variants': ['P', 'P']},
    'hyperparameters_have_sizes': {'hyperparameters.gamma': [1.0, 2.0]},
    'input_scaling_is_whole': {'hyperparameters.input_mean': [0.0, 0.0, 0.0], 'joints': ['a']},
    'hyperparameters_suffice': {'hyperparameters.sigma': [1.0]},
    'given_hyperparameters_know_their_features': {
        'variant': 'SPK-ML', 'features.count': 'auto', 'hyperparameters.gamma': [1.0], 'hyperparameters.rho': [1.0],
        'hyperparameters.tau': [1.0, 1.0, 1.0], 'hyperparameters.sigma': [1.0],
        'hyperparameters.output_scale': [1.0] * 6, 'hyperparameters.input_mean': [0.0] * 3,
        'hyperparameters.input_scale': [1.0] * 3, 'joints': ['a']},
    'state_file_is_a_plain_name': {'state_file': '../x.npz'},
    'effects_are_known': {'effects': ['payload{"a": }']},
    'tools_are_bodies': {'tools': ['hand {"mass": -1}']},
}


def test_a_state_file_has_no_name_of_a_checkpoint():
    """~/save_state and a checkpoint would write the same file in two threads."""
    assert 'no name of a checkpoint' in broken_rule(WRENCH.changed({'state_file': 'estimator.checkpoint.npz'}))


@pytest.mark.parametrize('rule', RULES, ids=lambda rule: rule.__name__)
def test_every_rule_holds_by_default_and_can_be_broken(rule):
    assert rule(WRENCH) is None
    broken = WRENCH.changed(BROKEN[rule.__name__])
    sentence = rule(broken)
    assert sentence is not None
    assert sentence.endswith('.') and '\n' not in sentence
    assert broken_rule(broken) is not None


@pytest.mark.parametrize(('effect', 'sentence'), [
    ('paylod', 'names no known kind'), ('payload{"start_s": "soon"}', 'not finite numbers'),
    ('viscous_friction@a', 'does not act on outputs wrench')])
def test_effects_are_refused_by_name(effect, sentence):
    assert sentence in broken_rule(WRENCH.changed({'effects': [effect]}))


def test_a_live_change_is_refused_with_the_same_sentence_as_a_file():
    assert refusal(WRENCH, {'variant': 'P', 'horizon.length': 10}) is None
    assert 'cannot change while the node runs' in refusal(WRENCH, {'features.count': 100})
    twice = {'shadow_variants': ['P', 'P']}
    assert refusal(WRENCH, twice) == broken_rule(WRENCH.changed(twice))
    assert refusal(WRENCH, {**twice, 'shadow_variants': ['P']}) is None
    assert "nearest is 'variant'" in refusal(WRENCH, {'varient': 'P'})


def test_an_empty_item_is_no_choice():
    parameter = Parameter('x', (), 'string_array', 'X.', choices=('a',))
    assert parameter.refusal(('a', 'b')) == "x is ['a', 'b']; expected one of a."


def test_estimator_follows_the_settings():
    settings = WRENCH.changed({'robot_description': URDF, 'joints': ['a', 'b'], 'features.count': 20,
                               'horizon.length': 7, 'initial.samples': 50})
    estimator = build_estimator(settings)
    assert estimator.body.joints == ('a', 'b')
    assert estimator.options.features_count == 20
    assert estimator.options.horizon == 7
    assert build_estimator(settings.changed({'joints': []})).body.joints == ('a', 'b')
    locked = settings.changed({'joints': [], 'locked_joints.names': ['a'], 'locked_joints.positions': [0.5]})
    assert build_estimator(locked).body.joints == ('b',)


def test_given_hyperparameters_survive_the_parameters():
    settings = WRENCH.changed({
        'hyperparameters.gamma': [0.5], 'hyperparameters.rho': [2.0], 'hyperparameters.sigma': [0.1],
        'hyperparameters.tau': [1.0, 2.0, 3.0], 'hyperparameters.output_scale': [1.0] * 6,
        'hyperparameters.input_mean': [0.0] * 6, 'hyperparameters.input_scale': [1.0] * 6,
        'robot_description': URDF, 'joints': ['a', 'b'], 'features.count': 20})
    assert broken_rule(settings) is None
    given_ones = given_hyperparameters(settings)
    values = hyperparameter_values(given_ones, settings.hyperparameters_input_mean,
                                   settings.hyperparameters_input_scale)
    assert settings.changed(values) == settings
    assert build_estimator(settings).ready


def test_the_number_of_features_is_a_number_or_auto(tmp_path):
    path = write(tmp_path / 'p.yaml', 'estimator: {ros__parameters: {sensor_frame: ft, features: {count: auto}}}')
    assert load_params(path).features_count == 'auto'
    dump_params(load_params(path), path)
    assert load_params(path).features_count == 'auto'
    assert Settings.from_mapping({'sensor_frame': 'ft', 'features.count': 100}).features_count == 100
    for wrong in (1, 100.0, 'automatic'):
        with pytest.raises(SemiparamError, match=r'features.count is .*2 to 20000, or auto'):
            Settings.from_mapping({'sensor_frame': 'ft', 'features.count': wrong})


def test_robot_description_is_looked_for_in_one_order(tmp_path):
    with pytest.raises(SemiparamError, match='no robot description'):
        build_estimator(WRENCH)
    assert build_estimator(WRENCH, URDF).body.joints == ('a', 'b')
    path = write(tmp_path / 'arm.urdf', URDF)
    assert build_estimator(WRENCH.changed({'robot_description_file': str(path)}), 'ignored').body.n_joints == 2
    for name in (str(tmp_path / 'none.urdf'), 'package://no_such_package/a.urdf', '~no_such_user/a.urdf', '/a\0b.urdf'):
        with pytest.raises(SemiparamError, match=r'none.urdf|no_such_package|no_such_user|null'):
            build_estimator(WRENCH.changed({'robot_description_file': name}))


def test_ros_itself_reads_the_file_with_the_same_types(tmp_path):
    """A whole file through rcl's own parser: every value arrives with the type that the table declares."""
    expected = WRENCH.changed({'effects': ['time_delay'], 'locked_joints.positions': [1e-7],
                               'locked_joints.names': ['a']})
    dump_params(expected, tmp_path / 'p.yaml')
    script = ('import rclpy, sys, yaml; from rclpy.node import Node\n'
              f"rclpy.init(args=['--ros-args', '--params-file', {str(tmp_path / 'p.yaml')!r}])\n"
              "node = Node('estimator', start_parameter_services=False)\n"
              'print(yaml.safe_dump({k: v.value for k, v in node._parameter_overrides.items()}))')
    answer = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True, check=True,
                            env={**os.environ, 'ROS_DOMAIN_ID': '50', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'})
    assert Settings.from_mapping(yaml.safe_load(answer.stdout)) == expected


def test_remarks_stand_above_the_items_of_a_list_and_change_no_value(tmp_path):
    settings = replace(Settings(), effects=('payload@r_hand', 'joint_offset@b{"offset": 0.1}', "terms{\"q_it's\": 1}"))
    remarks = {'effects': [['a load', '  mass: 1 kg'], ["it's: a [list] # of: {everything}" * 9], []], 'joints': []}
    dump_params(settings, tmp_path / 'p.yaml', remarks=remarks)
    text = (tmp_path / 'p.yaml').read_text()
    assert "      # a load\n      #   mass: 1 kg\n      - 'payload@r_hand'\n" in text
    assert not any(line.endswith(' ') for line in text.splitlines())
    assert max(map(len, text.splitlines())) <= 120
    values = read_params(tmp_path / 'p.yaml')
    assert (values['effects'], values['joints']) == (list(settings.effects), [])
    assert {name: value for name, value in values.items() if name != 'effects'} == \
        {name: value for name, value in read_params_of(params_text(Settings()), tmp_path).items() if name != 'effects'}


def read_params_of(text, folder):
    (folder / 'other.yaml').write_text(text)
    return read_params(folder / 'other.yaml')


def test_a_description_beside_the_parameter_file_is_found_there(tmp_path, monkeypatch):
    """From whatever folder a command is started; a path that is not there counts from the working folder, as ever."""
    (tmp_path / 'arms').mkdir()
    (tmp_path / 'arms/arm.urdf').write_text('<robot/>')
    section = '/**: {ros__parameters: {sensor_frame: ft, robot_description_file: arm.urdf}}'
    path = write(tmp_path / 'arms/p.yaml', section)
    monkeypatch.chdir(tmp_path)
    assert load_params('arms/p.yaml').robot_description_file == 'arms/arm.urdf'
    assert load_params(path).robot_description_file == str(tmp_path / 'arms/arm.urdf')
    for name in ('arms/arm.urdf', 'package://semiparam_ros/config/icub_right_arm.urdf', '/arm.urdf', '~/arm.urdf', ''):
        write(path, f"/**: {{ros__parameters: {{sensor_frame: ft, robot_description_file: '{name}'}}}}")
        assert load_params(path).robot_description_file == name
    assert parameter_files(['--ros-args', '--params-file', '/a/p.yaml', '-r', 'x:=y', '--params-file', 'q.yaml']) == [
        Path('q.yaml'), Path('/a/p.yaml')]


def test_of_a_parameter_given_twice_the_last_value_counts_whatever_their_types(tmp_path):
    """rcl keeps an integer beside a decimal number or a text, and hands over the integer: the command line was not
    heard."""
    path = write(tmp_path / 'p.yaml', '/**: {ros__parameters: {acceleration.cutoff: 10, features.count: 100, '
                                      'gate.hold: 1.0, variant: P, effects: [], other: 1}}')
    second = write(tmp_path / 'q.yaml', '/**/estimator: {ros__parameters: {gate.hold: 2}}')
    arguments = ['--ros-args', '--params-file', str(path), '--', '--ros-args', '-p', 'acceleration.cutoff:=20.0',
                 '--param', 'estimator:features.count:=auto', '-p', 'stranger:variant:=SPK-ML', '-p', 'other:=a',
                 '--params-file', str(second), '-p', 'horizon.length:=7', '-p', 'initial.samples:={', '-r', 'x:=y',
                 '--params-file', str(tmp_path / 'none.yaml')]
    assert last_words(arguments, '/estimator') == {'acceleration.cutoff': 20.0, 'features.count': 'auto',
                                                        'gate.hold': 2}


def test_off_is_what_yaml_reads_of_it(tmp_path):
    """YAML's ``off`` is false, which was refused with the sentence that it should be off."""
    path = write(tmp_path / 'p.yaml', '/**: {ros__parameters: {diagnosis.auto: off}}')
    assert load_params(path).diagnosis_auto == 'off'
    with pytest.raises(SemiparamError, match='variant is false'):
        Settings().changed({'variant': False})


def test_a_file_written_elsewhere_names_the_same_places(tmp_path, monkeypatch):
    """``fit -o`` into another folder moved the states with it, and lost the robot description."""
    (tmp_path / 'own').mkdir()
    (tmp_path / 'out').mkdir()
    (tmp_path / 'own/arm.urdf').write_text('<robot/>')
    write(tmp_path / 'own/p.yaml', '/**: {ros__parameters: {robot_description_file: arm.urdf, state_folder: states}}')
    monkeypatch.chdir(tmp_path)
    dump_params(load_params('own/p.yaml'), 'out/p.yaml')
    for folder in (tmp_path, tmp_path / 'own', Path('/')):
        monkeypatch.chdir(folder)
        found = load_params(tmp_path / 'out/p.yaml')
        assert Path(found.robot_description_file).resolve() == tmp_path / 'own/arm.urdf'
        assert Path(found.state_folder).resolve() == tmp_path / 'own/states'


def test_a_file_written_into_a_linked_folder_names_the_same_places(tmp_path, monkeypatch):
    """A ``..`` was counted from the link, and read from the folder that it leads to."""
    for folder in ('home/own', 'disk/of/data'):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / 'home/data').symlink_to(tmp_path / 'disk/of/data')
    (tmp_path / 'home/own/arm.urdf').write_text('<robot/>')
    write(tmp_path / 'home/own/p.yaml',
          '/**: {ros__parameters: {robot_description_file: arm.urdf, state_folder: states}}')
    monkeypatch.chdir(tmp_path / 'home')
    dump_params(load_params('own/p.yaml'), 'data/p.yaml')
    monkeypatch.chdir('/')
    found = load_params(tmp_path / 'home/data/p.yaml')
    assert Path(found.robot_description_file).resolve() == tmp_path / 'home/own/arm.urdf'
    assert Path(found.state_folder).resolve() == tmp_path / 'home/own/states'


def test_a_state_folder_counts_from_the_file_that_gives_it(tmp_path):
    (tmp_path / 'a').mkdir()
    first, last = (write(tmp_path / name, f'/**: {{ros__parameters: {{state_folder: {folder}}}}}')
                   for name, folder in (('a/p.yaml', 'states'), ('launch_params_x', 'launched')))
    broken, other = write(tmp_path / 'broken', '['), write(tmp_path / 'q.yaml', 'estimator: {ros__parameters: {}}')
    files = [other, last, broken, first, tmp_path / 'none.yaml']
    assert load_params(first).state_folder == str(tmp_path / 'a/states')
    for named, found in (('states', str(tmp_path / 'a/states')), ('launched', 'launched'), ('elsewhere', 'elsewhere'),
                         ('/states', '/states'), ('~/states', '~/states'), ('', '')):
        assert located(Settings(state_folder=named), files).state_folder == found


@pytest.mark.parametrize(('given', 'outputs'), [
    ({}, 'effort'), ({'sensor_frame': 'ft'}, 'wrench'), ({'outputs': 'auto'}, 'effort'),
    ({'outputs': 'auto', 'sensor_frame': 'ft'}, 'wrench'), ({'outputs': 'effort', 'sensor_frame': 'ft'}, 'effort')])
def test_outputs_follow_from_the_sensor_frame(given, outputs, tmp_path):
    settings = Settings.from_mapping(given)
    assert settings.outputs == outputs == Settings(**given).outputs == settings.changed({'variant': 'P'}).outputs
    dump_params(settings, tmp_path / 'p.yaml')
    assert load_params(tmp_path / 'p.yaml') == settings


@pytest.mark.parametrize(('section', 'fits'), [
    ('estimator', [True, False, False]), ('/estimator', [True, False, False]), ('/**', [True, True, True]),
    ('/**/estimator', [True, True, True]), ('/*/estimator', [False, True, False]), ("'*'", [True, False, False]),
    ('/left/estimator', [False, True, False]), ('/left/**', [False, True, True]), ('other', [False, False, False]),
    ('estimator/', [False, False, False]), ('left: {estimator', [False, True, False])])
def test_sections_are_those_that_ros_takes(tmp_path, section, fits):
    end = '}' * section.count('{')
    path = write(tmp_path / 'p.yaml', f'{section}: {{ros__parameters: {{}}}}{end}')
    for name, fit in zip(('/estimator', '/left/estimator', '/left/arm/estimator'), fits, strict=True):
        with nullcontext() if fit else pytest.raises(SemiparamError, match='ROS gives no section to the node'):
            read_params(path, name)


def test_a_bare_name_is_that_of_the_only_node_of_this_name_in_a_file(tmp_path):
    """Commands that start no node know no namespace; of two arms in one file they mixed the values."""
    text = '/**: {ros__parameters: {sensor_frame: ft}}\n/left/estimator: {ros__parameters: {variant: P}}\n'
    path = write(tmp_path / 'p.yaml', text)
    assert read_params(path) == {'sensor_frame': 'ft', 'variant': 'P'}
    write(path, text + 'right: {estimator: {ros__parameters: {variant: NP-ML}}}')
    assert read_params(path, '/left/estimator')['variant'] == 'P'
    with pytest.raises(SemiparamError, match=r'several nodes \(.*, right/estimator\); expected those of one'):
        load_params(path)


BOMB = '\n'.join([
    'a: &a [x, x, x, x]', *(f'{new}: &{new} [*{old}, *{old}, *{old}, *{old}]' for old, new in ('ab', 'bc', 'cd'))])


@pytest.mark.parametrize(('value', 'sentence'), [
    ('tools: [2020-13-45]', "in line 3: '2020-13-45' is no timestamp."),  # a ValueError of datetime
    ('forgetting: !!bool x', "in line 3: 'x' is no bool."),  # a KeyError
    ("""effects: ['payload@r_hand{"mass": 1, "mass": 2}']""", "'mass' is there twice"),  # was 2 kg
    (f'features.count: {"9" * 5000}', 'in line 3:.* is no int.'),  # a ValueError of int
    (f'forgetting: {"9" * 400}', 'forgetting is 999.*; expected a number, 0.5 to 1, or auto.'),  # an OverflowError
    ('joints: !!set {a, b}', 'expected a list of texts.'),  # in another order each time
    ('forgetting: 1.0\n    forgetting: 0.9', "in line 4: 'forgetting' is there twice."),  # was 0.9
    ('forgetting: 1.0\nestimator: {ros__parameters: {noise: one}}', "in line 4: 'estimator' is there twice."),
    ('learn.every: 2\n    learn: {every: 3}', "section 'estimator' gives learn.every twice; expected one value."),
    (BOMB.replace('\n', '\n    '), 'its aliases hold more than the whole file.')])  # minutes with ten more lines
def test_values_that_are_none_or_two_are_refused(value, sentence, tmp_path):
    path = write(tmp_path / 'p.yaml', f'estimator:\n  ros__parameters:\n    {value}\n')
    with pytest.raises(SemiparamError, match=sentence):
        load_params(path)


def test_an_alias_may_stand_for_what_is_named_elsewhere(tmp_path):
    path = write(tmp_path / 'p.yaml', """
        /**:
          ros__parameters: {joints: &all [shoulder, elbow], output_joints: *all, outputs: effort}
        estimator:
          ros__parameters:
            <<: {forgetting: 0.9}
            noise: one""")
    settings = load_params(path)
    assert (settings.output_joints, settings.forgetting, settings.noise) == (('shoulder', 'elbow'), 0.9, 'one')


@pytest.mark.parametrize(('name', 'item', 'most'), [('effects', 'payload@tool', 200), ('tools', 'tool', 100),
                                                    ('effects_reference', 0.0, 1000)])
def test_lists_are_no_longer_than_a_node_answers_with(name, item, most):
    """Of 700 loads, each with a start of its own, no service was answered for 2.4 s; 7600 asked for 43 GiB."""
    parameter = BY_NAME[name]
    assert parameter.refusal((item,) * most) is None
    assert parameter.refusal((item,) * (most + 1)) == f'{name} holds {most + 1} values; expected at most {most}.'
    assert f'at most {most} of them' in parameter.permitted
