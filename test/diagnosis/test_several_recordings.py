"""Several recordings in one diagnosis: an offset for each, and effects in some of them."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from semiparam_ros.cli.main import main
from semiparam_ros.core.samples import Samples
from semiparam_ros.core.signals.smoothing import smoothed
from semiparam_ros.diagnosis.data.outliers import excluded, gaps, working_factor
from semiparam_ros.diagnosis.data.recordings import (
    beside_breaks,
    during,
    own_time,
    present,
    whole_groups,
    without_pauses,
)
from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.diagnosis.preparation import of_one_rate
from semiparam_ros.diagnosis.residual.contacts import Contact
from semiparam_ros.diagnosis.residual.flexible import StandardisedInputs
from semiparam_ros.diagnosis.search.spans import around
from semiparam_ros.diagnosis.search.stepwise import starting_fit
from semiparam_ros.diagnosis.setup.identifiability import unidentifiable
from semiparam_ros.diagnosis.text_report import _contacts, text_report, when
from semiparam_ros.effects import effect_from_text, effect_to_text, kinds
from semiparam_ros.effects.base import Span
from semiparam_ros.errors import SemiparamError
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.report.diagnosis_page import diagnosis_page
from semiparam_ros.simulation.scenario import Scenario
from semiparam_ros.simulation.simulate import simulate
from support.arms import ODD_BODY, as_recorded, smooth_motion
from support.recordings import write_arm

LOAD = np.array([0.15, 0.0, 0.01, 0.01, 3e-3, 0.0, 2e-3, 0.0, 0.0, 2e-3])
JUMP = np.array([1.0, -2.0, 0.5, 0.1, 0.2, 0.05])


@cache
def recorded(outputs):
    """The body and three recordings of one robot."""
    made = [simulate(Scenario(samples=500, outputs=outputs, seed=seed, robot_seed=1, motion=motion))
            for seed, motion in ((1, 'circle_xy'), (2, 'circle_xz'), (3, 'circle_xy'))]
    return body_of(made[0]), [samples_of(recording) for recording in made]


@pytest.mark.parametrize(('outputs', 'loaded'), [('wrench', (1,)), ('effort', (1, 2))])
def test_a_load_in_some_of_the_recordings_is_found_there(outputs, loaded):
    """The middle one of three alone; of a wrench each recording also has another offset."""
    body, samples = recorded(outputs)
    load = kinds()['payload']('r_gripper')
    changed = []
    for number, part in enumerate(samples):
        added = load.columns(body, part, None)[0] @ LOAD * (number in loaded)
        changed.append(replace(part, outputs=part.outputs + added + (number * JUMP if outputs == 'wrench' else 0.0)))
    names = ('monday', 'tuesday', 'friday')
    found = diagnose(body, Samples.joined(changed), only=['payload', 'external_force', 'joint_offset'], names=names)
    there = tuple(names[number] for number in loaded)
    assert [(finding.effect.kind, found.recordings_of(finding.effect)) for finding in found.findings] == [
        ('payload', there)]
    mass = found.findings[0].parameters['mass']
    assert mass.value == pytest.approx(0.15, abs=max(4.0 * mass.std, 0.005))
    assert found.as_dict()['effects'][0]['recordings'] == list(there)
    assert any(f', in {" and ".join(there)} (' in line for line in text_report(found))
    assert [found.lasts(effect) for effect in found.final.effects if effect.kind == 'payload'] == [2 in loaded]
    assert (found.judged == found.held_out).all(), 'what begins with a recording begins at a known time'


def test_the_samples_that_judged_are_numbered_as_they_came():
    """Those of the second recording were numbered without what the first had more than whole groups of samples."""
    body, (first, second, _) = recorded('wrench')
    fast = [replace(part, stamps=part.stamps // 10) for part in (first[:497], second)]
    fast = [replace(part, velocity=10.0 * part.velocity, acceleration=0.0 * part.acceleration) for part in fast]
    joined = Samples.joined(fast)
    found = diagnose(body, joined, only=['viscous_drag'])
    factor, judged = found.inputs.factor, found.judged
    assert len(found.recorded.samples) < len(joined)
    told = np.concatenate([np.arange(*part) for part in found.as_dict()['held_out']['ranges']])
    assert np.array_equal(joined.stamps[told], found.recorded.samples.stamps[np.repeat(judged, factor)])
    assert told.max() > 497


def test_a_pause_between_recordings_of_hours_hides_nothing_that_depends_on_time():
    """Frequencies, time constants, what changes slowly and the neighbourhood of a time were searched as if the pause
    were recorded: a spectrum of steps of a second and a half, time constants from minutes on."""
    body, (first, second, _) = recorded('wrench')
    shaken = [replace(part, outputs=part.outputs + 20.0 * np.sin(2.0 * np.pi * 2.3 * part.time)[:, None])
              for part in (first, second)]
    told = []
    for pause_s in (10, 7200):
        moved = shaken[1].stamps - shaken[1].stamps[0] + shaken[0].stamps[-1] + pause_s * 10**9
        joined = Samples.joined([shaken[0], replace(shaken[1], stamps=moved)])
        fit = starting_fit(body, joined, [], np.ones(len(joined), dtype=bool))
        frequencies = [values['frequency_hz'] for values in kinds()['periodic_disturbance'].searches(
            body, joined, None, fit.residual)]
        assert min(np.abs(np.array(frequencies) - 2.3)) < 0.02
        drift = kinds()['thermal_drift'].searches(body, joined, None, fit.residual)
        assert min(values['time_constant_s'] for values in drift) < 2.0
        times = StandardisedInputs(body.joints, joined).values[:, -1]
        told.append([*np.subtract(around(fit, 5.0), 5.0), *times])
    assert told[0] == pytest.approx(told[1])


def test_the_page_of_several_recordings_holds_their_offsets_for_no_effects():
    """It said that they had been declared, and marked the beginning of each recording as theirs."""
    body, samples = recorded('wrench')
    found = diagnose(body, Samples.joined(samples[:2]), only=['viscous_drag'], names=('a', 'b'))
    assert len(found.offsets) == 1 and list(found.first.effects) == found.offsets
    text = diagnosis_page(found, {}, 'a, b')
    assert 'sensor_offset' not in text and '<dd>no effects</dd>' in text
    assert '1000 samples over 49.9 s, one in 50 ms' in text, 'without the pause between them'


def test_motion_that_is_too_fast_is_said_to_be_of_several_recordings_too():
    """Errors of accelerations were told of one recording alone: of three that lack nothing each by itself, 'something'
    was missing together, three per cent of what was left."""
    fast = [as_recorded(ODD_BODY, smooth_motion(4, 500, seed=20 + seed, speed=0.8), seed=seed, noise=1e-3)
            for seed in (1, 2, 3)]
    for samples in (fast[1], Samples.joined(fast)):
        found = diagnose(ODD_BODY, samples, only=['joint_spring'])
        assert found.verdict == 'nothing_missing'
        assert any('too fast for 20 Hz' in note for note in found.notes)


def test_recordings_of_different_rates_are_joined_at_about_the_slowest():
    """The slower one was averaged by as many samples as the faster one asks: over 0.3 s of 40 Hz beside 500 Hz."""
    fast, slow = smooth_motion(4, 6000, rate=500.0), smooth_motion(4, 480, rate=40.0, seed=1)
    again, same = of_one_rate([fast, slow])
    assert same is slow and len(again) == 500 and np.median(np.diff(again.time)) == pytest.approx(0.024)
    assert working_factor(Samples.joined([again, same])) == 1
    assert [one is other for one, other in zip(of_one_rate([fast, fast]), [fast, fast], strict=True)] == [True, True]


def test_another_offset_on_the_recording_that_judges_is_said_to_be_one():
    """The advice was to look at the output's sign, its unit, or for contact."""
    body, (one, two, _) = recorded('wrench')
    moved = replace(two, outputs=two.outputs + 3.0 * two.outputs.std(axis=0) * np.eye(6)[1])
    found = diagnose(body, one, other=('tared anew', moved), only=['viscous_drag'])
    assert found.shifted_outputs == list(found.unexplained_outputs) == ['fy']
    text = text_report(found)
    assert any('The offset of its sensor is another one there' in line for line in text)
    assert found.verdict == 'nothing_missing' and not any('Nothing is missing' in line for line in text)


def test_the_page_shows_recordings_hours_apart():
    """Each was a line of ink at the edge of an empty picture."""
    _, samples = recorded('wrench')
    later = samples[1].stamps + 5 * 3600 * 10**9
    joined = Samples.joined([samples[0], replace(samples[1], stamps=later, origin=int(later[0]))])
    time, second = without_pauses(joined), joined.recordings[1]
    assert joined.time[-1] > 17000.0 and np.all(np.diff(time) > 0.0)
    assert time[second.start] == pytest.approx(joined.time[second.start - 1] + 1.0)
    np.testing.assert_allclose(np.diff(time[second]), np.diff(joined.time[second]), atol=1e-6)
    assert without_pauses(samples[0]) == pytest.approx(samples[0].time)


def test_recordings_are_joined_without_touching_one_another():
    _, (one, two, three) = recorded('wrench')
    joined = Samples.joined([one, two, three])
    assert [part.stop - part.start for part in joined.recordings] == [500, 500, 500]
    assert (np.diff(joined.stamps) > 0).all() and gaps(joined) == []
    np.testing.assert_allclose(smoothed(joined).acceleration[500:1000], smoothed(two).acceleration, atol=1e-6)
    np.testing.assert_array_equal(excluded(joined), np.concatenate([excluded(part) for part in (one, two, three)]))
    assert np.flatnonzero(beside_breaks(joined, 2)).tolist() == [498, 499, 500, 501, 998, 999, 1000, 1001]
    assert [part.stop - part.start for part in whole_groups(joined, 3).recordings] == [498, 498, 498]
    later = replace(two, stamps=two.stamps - two.stamps[0] + one.stamps[-1] + 10**10)
    assert Samples.joined([one, later]).stamps[-1] == later.stamps[-1]  # true stamps stay
    with pytest.raises(SemiparamError, match='expected at least one'):
        Samples.joined([])


@pytest.mark.parametrize('count', [2, 12])
def test_a_recording_of_a_moment_does_no_harm(count):
    """It ended with an internal error, or was told to jump."""
    body, (one, two, _) = recorded('wrench')
    alone, beside = (diagnose(body, samples, only=['payload']) for samples in (one, Samples.joined([one, two[:count]])))
    assert beside.verdict == alone.verdict and not beside.findings
    with pytest.raises(SemiparamError, match=f'recording 2 holds {count} samples; expected at least 20'):
        whole_groups(Samples.joined([one, two[:count]]), 20)


def test_runs_of_recordings():
    _, samples = recorded('wrench')
    joined = Samples.joined(samples)
    load = kinds()['payload']('r_gripper')
    assert present(joined, 'ABC', during(joined, 1, load)) == ('B',)
    assert effect_to_text(during(joined, 1, load).without_span()) == 'payload@r_gripper'


def test_a_mask_of_what_fits_is_of_all_samples_of_several_recordings():
    """Where faster ones are averaged it had the remainders too that are left out: no mask of any length was right."""
    made = [simulate(Scenario(samples=count, rate_hz=100.0, outputs='effort', seed=count, robot_seed=1))
            for count in (801, 1003)]
    joined = Samples.joined([samples_of(recording) for recording in made])
    mask = np.arange(len(joined)) % 400 < 300
    found = diagnose(body_of(made[0]), joined, train_mask=mask, only=['effort_offset'])
    kept = np.r_[0:800, 801:1803]
    np.testing.assert_array_equal(found.recorded.samples.stamps, joined.stamps[kept])
    assert not (found.recorded.fitting & ~mask[kept]).any() and not (found.recorded.valid & mask[kept]).any()


def test_only_the_first_recording_has_a_date():
    """Another one, that was recorded before it, had the date of a minute after the end of the first."""
    _, samples = recorded('wrench')
    joined, load = Samples.joined(samples), kinds()['payload']('r_gripper')
    told = SimpleNamespace(names=('late', 'early'), recordings_of=lambda effect: (),
                           recorded=SimpleNamespace(samples=joined))
    first, second = (replace(load, span=Span(5.0 + start_s)) for start_s in (0.0, joined.time[joined.recordings[1]][0]))
    assert when(told, first).startswith(', since 5.0 s of late (2023-')
    assert when(told, second) == ', since 5.0 s of early'
    told.names = ('run (1)', 'early')
    assert when(told, first, dated=False) == ', since 5.0 s of run (1)'


def test_times_count_from_the_beginning_of_their_recording():
    """Those of touches and gaps counted through all of them, pauses included."""
    body, samples = recorded('wrench')
    joined = Samples.joined([samples[0], samples[1][np.r_[0:100, 140:500]]])
    (told,) = [note for note in unidentifiable(body, joined, names=('a', 'b')) if 'gap' in note]
    assert 'namely 2.05 s from 4.95 s of b on' in told
    begin = joined.time[joined.recordings[1]][0]
    assert own_time(joined, ('a', 'b'), begin) == (0.0, ' of b')
    seen = SimpleNamespace(names=('a', 'b'), recorded=SimpleNamespace(samples=joined), contacts=[
        Contact(begin + 3.0, begin + 3.5, {'fx': 2.0}, None)], first=SimpleNamespace(body=body))
    assert _contacts(seen)[1] == '  3.0 to 3.5 s of b: fx +2 N.'


@pytest.mark.parametrize('number', [0, 1, 2])
def test_times_of_an_effect_in_one_recording_count_from_its_beginning(number):
    """They counted from that of the first, in which the effect then was too, and an end was not heeded; or a late one
    put it into those after it."""
    joined = Samples.joined(recorded('wrench')[1])
    part = joined.recordings[number]
    time = joined.time[part] - joined.time[part.start]
    for text, wanted in (('{"start_s": 5.01}', time > 5.01), ('{"end_s": 5.01}', time < 5.01),
                         ('{"start_s": 2.01, "end_s": 5.01}', (time > 2.01) & (time < 5.01)),
                         ('{"start_s": 2.01, "end_s": 500.0}', time > 2.01)):
        span = during(joined, number, effect_from_text(f'payload@r_gripper{text}')).span
        holds = span.holds(joined.stamps, joined.origin)
        np.testing.assert_array_equal(holds[part], wanted)
        assert holds.sum() == wanted.sum()


def test_the_command_takes_several_bags(tmp_path, capsys):
    config = 'config/icub_right_arm.yaml'
    one, two = (str(write_arm(tmp_path / f'{name}.mcap', 300, seed)) for seed, name in enumerate('ab'))
    assert main(['diagnose', one, two, '--params', config, '--kinds', 'payload', '-o', str(tmp_path / 'p.yaml')]) == 0
    capsys.readouterr()
    assert 'sensor_offset' not in (tmp_path / 'p.yaml').read_text()
    assert main(['diagnose', one, two, '--params', config, '--split', '0.5']) == 2
    assert 'name the one that judges with --judge' in ' '.join(capsys.readouterr().err.split())
    assert main(['diagnose', one, '--params', config, '--in', two, 'payload@r_gripper']) == 2
    assert 'expected one of the recordings' in ' '.join(capsys.readouterr().err.split())
