"""The scoreboard: simulated, diagnosed and counted, by the command itself."""


import pytest

from semiparam_ros import effects
from semiparam_ros.experiments.scoreboard import body_of, summary, true_values
from semiparam_ros.simulation.causes import kinds
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate
from support.commands import document


def test_the_command_diagnoses_every_case_and_counts(tmp_path, capsys):
    result = document(tmp_path / 'board.json', 'diagnose', '--benchmark', '--outputs', 'effort', '--kinds',
                      'viscous_friction', '--seeds', 1, '--sizes', 1, '--samples', 1500, '--jobs', 1)
    assert [row['kind'] for row in result['rows']] == ['viscous_friction', 'nothing']
    hidden, clean = result['rows']
    assert hidden['found'][0] == 'viscous_friction' and hidden['removed'] > 0.9 and 0.0 < hidden['visible_share'] < 0.1
    assert clean['verdict'] == 'nothing_missing' and not clean['found']
    assert result['summary']['right_first'] == 1.0 and result['summary']['false_alarms'] == 0.0
    assert hidden['start_off_samples'] is None and len(hidden['deviations_off']) == 1
    assert abs(hidden['deviations_off'][0]) < 4.0
    assert 'right kind first: 100.0 %' in capsys.readouterr().out


def row(kind, verdict, found=(), group=(), removed=1.0, start_off=None, off=()):
    return {'kind': kind, 'verdict': verdict, 'found': list(found), 'group': list(group), 'removed': removed,
            'start_off_samples': start_off, 'deviations_off': list(off)}


def test_starts_within_two_samples_and_values_within_two_deviations_are_counted():
    rows = [row('a', 'effect_found', ['a'], start_off=2.0, off=[-1.9, 2.1]), row('a', 'effect_found', ['a'], off=[0.3]),
            row('b', 'effect_found', ['b'], start_off=2.1, off=[-2.1])]
    counted = summary(rows)
    assert counted['starts_near'] == pytest.approx(1 / 2) and counted['values_sure'] == pytest.approx(2 / 4)


@pytest.mark.parametrize('kind', kinds('effort'))
def test_the_truth_of_every_kind_has_the_names_of_its_effect(kind):
    made = simulate(Scenario(motion='mixed', samples=200, outputs='effort', effects=(EffectRequest(kind),), seed=1))
    true, known = made.truth[0], effects.kinds('effort')
    if kind in known and not kind.startswith('cable_'):
        effect = known[kind](true['where'])
        body = body_of(made)
        named = {entry.name for entry in (*effect.coefficients(body), *effect.calibrations)}
        assert named & true_values(true).keys()


def test_only_a_report_that_names_the_kind_counts_as_right():
    rows = [row('a', 'effect_found', ['a', 'c']), row('a', 'effect_found', ['b'], ['a']),
            row('a', 'effect_found', ['b', 'a']), row('a', 'unexplained', ['a', 'b'], ['a'], removed=0.5),
            row('b', 'nothing_missing', removed=0.0),
            row('nothing', 'nothing_missing'), row('nothing', 'effect_found', ['c']), row('nothing', 'unexplained')]
    counted = summary(rows)
    assert counted['right_first'] == pytest.approx(1 / 5)
    assert counted['right_or_in_group'] == pytest.approx(2 / 5)
    assert counted['exactly'] == 0.0
    assert counted['false_alarms'] == pytest.approx(2 / 3)
    assert counted['removed_median'] == 1.0
    assert counted['by_kind'] == {'a': 0.5, 'b': 0.0}
    assert counted['confusion'] == {'a': {'a': 1, 'b': 2, 'unexplained': 1}, 'b': {'nothing_missing': 1}}


def test_exactly_the_hidden_kinds_is_all_of_them_and_nothing_beside_them():
    rows = [row('a', 'effect_found', ['a']), row('a', 'effect_found', ['a', 'b']), row('a', 'unexplained', ['a']),
            row('a+b', 'effect_found', ['b', 'a']), row('a+b', 'effect_found', ['a']),
            row('a+b', 'effect_found', ['c', 'a', 'b'], ['b'])]
    counted = summary(rows)
    assert counted['exactly'] == pytest.approx(2 / 6)
    assert counted['right_first'] == pytest.approx(4 / 6) and counted['right_or_in_group'] == pytest.approx(5 / 6)
