"""The scoreboard: simulated, diagnosed and counted, by the command itself."""

import json

import pytest

from semiparam_ros.cli.main import main
from semiparam_ros.experiments.scoreboard import summary


def test_the_command_diagnoses_every_case_and_counts(tmp_path, capsys):
    path = tmp_path / 'board.json'
    assert main(['diagnose', '--benchmark', '--outputs', 'effort', '--kinds', 'viscous_friction', '--seeds', '1',
                 '--sizes', '1', '--samples', '1500', '--jobs', '1', '--json', str(path)]) == 0
    result = json.loads(path.read_text())
    assert [row['kind'] for row in result['rows']] == ['viscous_friction', 'nothing']
    hidden, clean = result['rows']
    assert hidden['found'][0] == 'viscous_friction' and hidden['removed'] > 0.9 and 0.0 < hidden['visible_share'] < 0.1
    assert clean['verdict'] == 'nothing_missing' and not clean['found']
    assert result['summary']['right_first'] == 1.0 and result['summary']['false_alarms'] == 0.0
    assert 'right kind first: 100.0 %' in capsys.readouterr().out


def row(kind, verdict, found=(), group=(), removed=1.0):
    return {'kind': kind, 'verdict': verdict, 'found': list(found), 'group': list(group), 'removed': removed}


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
