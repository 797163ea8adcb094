"""From when to when an effect acts: loads picked up and put down, declared or not."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from semiparam_ros.diagnosis.config import DEFAULTS
from semiparam_ros.diagnosis.diagnose import _decided, diagnose
from semiparam_ros.diagnosis.findings import places_in
from semiparam_ros.diagnosis.named_change import Gain
from semiparam_ros.diagnosis.preparation import averaged
from semiparam_ros.diagnosis.search.moves import Move, ending_moves, simplest
from semiparam_ros.diagnosis.search.plausibility import all_plausible
from semiparam_ros.diagnosis.search.refit import declare
from semiparam_ros.diagnosis.search.score import block_gains, gain
from semiparam_ros.diagnosis.search.stepwise import search, starting_fit
from semiparam_ros.diagnosis.text_report import summary, text_report
from semiparam_ros.effects import kinds
from semiparam_ros.effects.base import Span
from semiparam_ros.online import diagnosis_jobs
from support.arms import ODD_BODY, noisy, smooth_motion

BODY = ODD_BODY
COUNT = 900
LOAD = np.array([0.4, 0.01, 0.0, 0.02, *[0.0] * 6])
ONLY = ('payload', 'external_force', 'effort_offset')


def carrying(*spans, seed=3):
    """An odd arm in motion that carries a load in each of these spans [s]; its efforts with 1 % of noise."""
    motion = smooth_motion(4, COUNT, seed=seed, speed=0.5)
    outputs = noisy(BODY.regressors(motion) @ BODY.base_parameters, seed=seed)
    for start_s, end_s in spans:
        load = kinds()['payload']('tool', span=Span(start_s, end_s=end_s))
        outputs += load.columns(BODY, motion, None)[0] @ LOAD
    return replace(motion, outputs=outputs)


@cache
def found_in(*spans):
    return diagnose(BODY, carrying(*spans), only=ONLY)


END_S = float(smooth_motion(4, COUNT, seed=3, speed=0.5).time[-1])


@pytest.mark.parametrize('span', [(None, 0.6 * END_S), (0.3 * END_S, 0.7 * END_S)])
def test_a_load_that_is_picked_up_and_put_down_is_one_load_with_both_times(span):
    found = found_in(span)
    assert [finding.effect.kind for finding in found.findings] == ['payload']
    effect, mass = found.findings[0].effect, found.findings[0].parameters['mass']
    for told, true in zip((effect.start_s, effect.end_s), span, strict=True):
        assert told is true is None or told == pytest.approx(true, abs=0.15)
    assert abs(mass.value - LOAD[0]) < 4.0 * mass.std + 0.01
    assert found.after.nmse.mean() < 0.5 * found.before.nmse.mean()
    assert not found.lasts(effect)
    entry = found.as_dict()['effects'][0]
    assert (entry['start_s'], entry['end_s']) == (effect.start_s, effect.end_s)


def test_when_it_was_is_said():
    found = found_in((0.3 * END_S, 0.7 * END_S))
    effect = found.findings[0].effect
    said = f', since {effect.start_s:.1f} s, until {effect.end_s:.1f} s'
    assert any(said in line for line in text_report(found)) and any(said in line for line in summary(found))


def test_a_declared_load_that_was_put_down_ends_and_is_no_second_force():
    samples = carrying((0.2 * END_S, 0.6 * END_S))
    known = kinds()['payload']('tool', span=Span(0.2 * END_S))
    found = diagnose(BODY, samples, [known], only=ONLY)
    assert [(finding.effect.kind, finding.effect.where) for finding in found.findings] == [('payload', 'tool')]
    assert found.findings[0].effect.end_s == pytest.approx(0.6 * END_S, abs=0.15) and not found.declared
    effects = diagnosis_jobs.declared(found)
    assert [set(effect.span.values) for effect in effects] == [{'start_stamp_s', 'end_stamp_s'}]
    again = diagnose(BODY, samples, effects, only=ONLY)
    assert again.verdict == 'nothing_missing' and diagnosis_jobs.declared(again) == effects


def test_a_load_until_a_time_is_not_the_declared_one_that_stays():
    """Both had one key: the declared one was told as found, with other values than declared and a gain of -0 nat, and
    the one that was put down as declared."""
    known = kinds()['payload']('tool', {'mass': 0.3})
    samples = carrying((None, 0.6 * END_S))
    carried = known.columns(BODY, samples, None)[0] @ known.prior_mean(BODY)
    found = diagnose(BODY, replace(samples, outputs=samples.outputs + carried), [known], only=ONLY)
    (finding,), (stays,) = found.findings, found.declared
    assert finding.effect.end_s == pytest.approx(0.6 * END_S, abs=0.15) and finding.log_evidence_gain > 1000.0
    assert stays.effect == known and found.standing == [known]
    assert text_report(found)[0] == 'The model lacks one effect.'


def test_a_declared_load_that_was_always_there_and_is_over_stays_declared():
    names = ('mass', 'first_moment_x', 'first_moment_y', 'first_moment_z')
    known = kinds()['payload']('tool', dict(zip(names, LOAD[:4].tolist(), strict=True)))
    found = diagnose(BODY, carrying((None, 0.6 * END_S)), [known], only=ONLY)
    (effect,) = (finding.effect for finding in found.findings)
    assert effect.end_s == pytest.approx(0.6 * END_S, abs=0.15) and effect.parameters == known.parameters
    assert not found.declared and text_report(found)[0] == 'One effect has other values than declared.'


def test_a_load_that_ended_in_a_later_round_makes_no_finding_of_the_declared_one():
    """The round that ended it was taken for one that had added the other load at its place."""
    declared, begun = (kinds()['payload']('tool', span=span) for span in (Span(), Span(5.0)))
    ended = replace(begun, where='finger', span=Span(5.0, end_s=30.0))
    rounds = [SimpleNamespace(added=(begun,)), SimpleNamespace(added=(replace(ended, where='tool'),))]
    assert places_in(SimpleNamespace(effects=(declared, ended)), rounds) == [(1, 1)]


def test_a_load_that_comes_again_is_another_one():
    found = found_in((0.15 * END_S, 0.4 * END_S), (0.65 * END_S, None))
    told = sorted((finding.effect.start_s, finding.effect.end_s) for finding in found.findings)
    assert [finding.effect.kind for finding in found.findings] == ['payload'] * 2
    assert told[0] == pytest.approx((0.15 * END_S, 0.4 * END_S), abs=0.15)
    assert told[1][0] == pytest.approx(0.65 * END_S, abs=0.15) and told[1][1] is None


@pytest.mark.parametrize('span', [
    pytest.param((None, 0.6 * END_S), marks=pytest.mark.long), (0.3 * END_S, 0.7 * END_S)])
def test_a_force_that_ends_is_one_force_with_its_times(span):
    samples = carrying()
    force = kinds()['external_force']('tool', span=Span(span[0], end_s=span[1]))
    pushed = samples.outputs + force.columns(BODY, samples, None)[0] @ np.array([0.0, 3.0, 4.0])
    found = diagnose(BODY, replace(samples, outputs=pushed), only=ONLY)
    assert [finding.effect.kind for finding in found.findings] == ['external_force']
    effect = found.findings[0].effect
    for told, true in zip((effect.start_s, effect.end_s), span, strict=True):
        assert told is true is None or told == pytest.approx(true, abs=0.15)


def test_the_block_that_tells_a_searched_time_does_not_count():
    samples = carrying((0.5 * END_S, None))
    load = kinds()['payload']('tool', span=Span(0.5 * END_S))
    without, with_it = (starting_fit(BODY, samples, effects, np.ones(COUNT, dtype=bool)) for effects in ([], [load]))
    each = block_gains(without, with_it)
    assert gain(without, with_it, [0.5 * END_S]).total == pytest.approx(each.sum() - each.max())


def test_what_weighs_less_than_nothing_was_not_put_down():
    """Of a robot that picked up another load, the declared one was told to end then, with the other's mass below zero;
    and the other was refused where it left the declared one nothing to weigh."""
    def fit(*span):
        return starting_fit(BODY, carrying(span), [kinds()['payload']('tool')], np.ones(COUNT, dtype=bool))

    picked_up, put_down = fit(0.4 * END_S, None), fit(None, 0.6 * END_S)
    assert not ending_moves(picked_up)
    assert [move.added[0].end_s for move in ending_moves(put_down)] == [pytest.approx(0.6 * END_S, abs=0.15)]
    assert all_plausible(picked_up, declare(picked_up, [kinds()['payload']('tool', span=Span(0.4 * END_S))]))


@pytest.mark.parametrize('start_s', [END_S + 500.0, END_S + 1e-3, END_S])
def test_what_was_declared_to_begin_after_the_recording_is_not_over(start_s):
    """The diagnosis broke off: it ended before it began."""
    known = kinds()['payload']('tool', span=Span(start_s))
    found = diagnose(BODY, carrying(), [known], only=ONLY)
    assert found.verdict == 'nothing_missing' and found.declared[0].effect == known


def test_a_load_that_stays_is_not_ended():
    known = kinds()['payload']('tool', span=Span(0.3 * END_S))
    found = diagnose(BODY, carrying((0.3 * END_S, None)), [known], only=ONLY)
    assert found.verdict == 'nothing_missing' and not found.declared[0].effect.ends


def test_rounding_tells_no_times_apart(monkeypatch):
    """A zero that jumped was told until that time, with the opposite sign, where the last digit fell so."""
    monkeypatch.setattr('semiparam_ros.diagnosis.search.moves.gain', lambda *_: Gain(1e-9, 0.0))

    def move(span, total):
        offset = kinds()['effort_offset']('turn', span=span)
        after = SimpleNamespace(effects=(offset,), body=BODY, config=DEFAULTS, forget=lambda *kept: None)
        return Move((offset,), after, Gain(total, 0.0), 10.0)

    since, until = move(Span(5.0), 30.0), move(Span(end_s=5.0), 30.0 + 1e-9)
    assert simplest([until, since]) is since


@pytest.mark.parametrize(('difference', 'kind'), [(2.0, 'rotor_inertia'), (4.0, 'joint_offset')])
def test_what_the_description_leaves_open_is_taken_before_a_wrong_zero_that_is_hardly_likelier(
        difference, kind, monkeypatch):
    """Where two axes are parallel, a zero that is off by .2 to .3 rad imitated the rotor of the second."""
    def over(one, other):
        return Gain(difference if one.effects[0].kind == 'rotor_inertia' else -difference, 1.0)

    def move(effect, total):
        after = SimpleNamespace(effects=(effect,), body=BODY, config=DEFAULTS, forget=lambda *kept: None)
        return Move((effect,), after, Gain(total, 0.0), 10.0)

    monkeypatch.setattr('semiparam_ros.diagnosis.search.moves.gain', over)
    zero, rotor = kinds()['joint_offset']('turn', {'offset': 0.2}), kinds()['rotor_inertia']('elbow')
    assert simplest([move(zero, 28.0), move(rotor, 20.0)]).added[0].kind == kind


@pytest.mark.parametrize(('late', 'judges'), [(-51, False), (0, False), (1, False), (40, True)])
def test_a_start_just_beside_a_gap_may_lie_within_it(late, judges):
    """A load was told one sample after a gap: the second before, in which it was there, judged as if it was not."""
    samples, gap = smooth_motion(2, 400), slice(150, 200)
    effect = kinds()['payload']('tool', span=Span(start_s=float(samples.time[gap.stop + late])))
    held_out = np.zeros(400, dtype=bool)
    held_out[gap] = held_out[300:] = True
    final = SimpleNamespace(effects=(effect,), samples=samples, correlation=np.array([7.0, 1.3]))
    judged = _decided(final, [SimpleNamespace(added=(effect,))],
                      SimpleNamespace(held_out=held_out, fitting=~held_out))
    assert judged[gap].all() == judged[gap].any() == judges and judged[300:].all()


@pytest.mark.parametrize('share', [0.3, 0.5, 0.7])
def test_a_load_that_comes_within_a_working_sample_is_one_load(share):
    """The mean over the time in which it came is half loaded. A second load, a working sample later or earlier, made up
    for that: one of 3 kg was told as 1.55 kg at the flange and 1.45 kg at the wrist."""
    fine, heavy = smooth_motion(4, 6000, rate=100.0, speed=0.5), 4.0 * LOAD
    load = kinds()['payload']('tool', span=Span(30.0 + 0.05 * share))
    outputs = noisy(BODY.regressors(fine) @ BODY.base_parameters, share=0.002)
    outputs += load.columns(BODY, fine, None)[0] @ heavy
    samples = averaged(replace(fine, outputs=outputs, whole=True), 5)
    steps = search(starting_fit(BODY, samples, [], np.ones(len(samples), dtype=bool),
                                considered={kind: kinds('effort')[kind] for kind in ONLY}))
    found = steps[-1].after
    assert [effect.kind for effect in found.effects] == ['payload']
    assert found.effects[0].start_s == pytest.approx(load.start_s, abs=0.1)
    assert found.theta[found.assembly.blocks['0']][:4] == pytest.approx(heavy[:4], abs=1e-3)
