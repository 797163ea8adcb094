"""The thresholds of the diagnosis: all in one place, each explained, each in use, each passed on."""

import ast
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from semiparam_ros.diagnosis.config import DEFAULTS, DiagnosisConfig
from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate

ROOM = Path(__file__).resolve().parents[2] / 'semiparam_ros' / 'diagnosis'
TREES = {path: ast.parse(path.read_text(encoding='utf-8')) for path in sorted(ROOM.rglob('*.py'))}
NAMES = [each.name for each in fields(DiagnosisConfig)]

# What decides nothing: how much a text shows, steps of derivatives, guards of arithmetic, constants of mathematics.
NUMBERS_ELSEWHERE = {'MOST_PARAMETERS', 'MOST_IN_ROW', 'MOST_DECIMALS', 'MOST_GAPS_NAMED', 'DERIVATIVE_STEP',
                     'DIFFERENCE', 'POINT_DIFFERENCE', 'GAIN_STEP', 'POINT_REACH', 'START_RIDGE', 'WHITENING',
                     'RANK', 'ACCELERATIONS', 'NORMAL_MAD', 'ROUNDED', 'DEGREE', 'EARLIEST_DATE_S', 'SMOOTHED',
                     'OF_PSEUDO_INERTIA'}


def calls(tree):
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call)]


def called(call):
    return getattr(call.func, 'id', None) or getattr(call.func, 'attr', None)


def test_every_threshold_is_explained():
    """By one sentence below it, which starts with what the diagnosis does."""
    body = next(node for node in ast.walk(TREES[ROOM / 'config.py']) if isinstance(node, ast.ClassDef)).body[1:]
    assert len(body) == 2 * len(NAMES)
    for entry, sentence in zip(body[::2], body[1::2], strict=True):
        text = ast.literal_eval(sentence.value)
        assert len(text) > 30 and text[0].isupper() and text.rstrip().endswith('.'), entry.target.id


def test_every_threshold_is_used():
    users = [*TREES, ROOM.parent / 'report' / 'diagnosis_page.py']
    texts = [path.read_text(encoding='utf-8') for path in users]
    assert [name for name in NAMES if not any(f'config.{name}' in text for text in texts)] == []


def test_no_other_module_holds_a_threshold():
    numbers = {target.id for tree in TREES.values() for node in tree.body if isinstance(node, ast.Assign)
               for name in node.targets for target in ast.walk(name) if isinstance(target, ast.Name)
               if any(isinstance(part, ast.Constant) and isinstance(part.value, (int, float))
                      for part in ast.walk(node.value))}
    assert {name for name in numbers if not name.endswith('_UNITS')} == NUMBERS_ELSEWHERE


def test_the_thresholds_are_passed_on_everywhere():
    """A call that forgets them would work with the usual ones."""
    functions = {node.name: [arg.arg for arg in node.args.args] for tree in TREES.values() for node in ast.walk(tree)
                 if isinstance(node, ast.FunctionDef) and any(arg.arg == 'config' for arg in node.args.args)}
    functions |= {'Motion': ['joints', 'samples', 'config']}
    assert len(functions) > 20
    for path, tree in TREES.items():
        for call in calls(tree):
            place = functions.get(called(call))
            assert place is None or len(call.args) > place.index('config') or any(
                isinstance(arg, ast.Starred) for arg in call.args) or any(
                keyword.arg == 'config' for keyword in call.keywords), f'{path}:{call.lineno}'


@pytest.fixture(scope='module')
def drifting():
    recording = simulate(Scenario(samples=400, seed=1, effects=(EffectRequest('sensor_drift', size=2.0),)))
    return body_of(recording), samples_of(recording)


def verdict_with(drifting, **changed):
    found = diagnose(*drifting, only=('sensor_drift',), config=replace(DEFAULTS, **changed))
    return found.verdict, [finding.effect.kind for finding in found.findings]


@pytest.mark.parametrize(('changed', 'expected'), [
    ({}, ('effect_found', ['sensor_drift'])),
    ({'odds': np.inf}, ('nothing_missing', [])),
    ({'coarseness': 0.01}, ('nothing_missing', [])),
    ({'most_rounds': 0}, ('nothing_missing', [])),
    ({'most_rounds': 0, 'structure_least_samples': 100, 'structure_share': 0.0, 'beyond_chance': -99.0},
     ('unexplained', [])),
    ({'no_match_share': 0.0, 'little': 0.0}, ('unexplained', [])),
])
def test_another_threshold_gives_another_verdict(drifting, changed, expected):
    assert verdict_with(drifting, **changed) == expected


def test_what_a_recording_must_hold_is_a_threshold_too(drifting):
    with pytest.raises(SemiparamError, match='at least 500'):
        verdict_with(drifting, least_samples=500)


def test_the_figures_of_a_diagnosis_use_its_thresholds(drifting):
    usual = diagnose(*drifting, only=('sensor_drift',))
    narrow = diagnose(*drifting, only=('sensor_drift',), config=replace(DEFAULTS, confidence_percentiles=(45.0, 55.0)))
    assert np.diff(narrow.after.interval()) < 0.5 * np.diff(usual.after.interval())
    assert narrow.after.nmse == pytest.approx(usual.after.nmse)
