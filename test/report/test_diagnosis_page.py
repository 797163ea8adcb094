"""The page of a diagnosis: opens without an error, says what the diagnosis says, and draws what it claims to draw."""

import html
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import yaml
from matplotlib.colors import to_hex

from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.diagnosis.diagnose import diagnose
from semiparam_ros.diagnosis.named_change import Quantity
from semiparam_ros.diagnosis.regression import fit_model
from semiparam_ros.diagnosis.residual.formula import Dependence, Formula, Summand
from semiparam_ros.diagnosis.residual.structure import Structure
from semiparam_ros.diagnosis.search.scoring import Trial
from semiparam_ros.diagnosis.search.stepwise import Rival, Step
from semiparam_ros.diagnosis.text_report import error_text, next_step, rounded, table_rows, text_report
from semiparam_ros.effects import Effect, effect_from_text, effect_to_text, kinds
from semiparam_ros.effects.base import Span, place
from semiparam_ros.experiments.scoreboard import body_of, samples_of
from semiparam_ros.report import diagnosis_figures as figures
from semiparam_ros.report.diagnosis_figures import against_unexplained, dependence, suspected_variable, suspicions
from semiparam_ros.report.diagnosis_page import (
    diagnosis_page,
    odds_text,
    output_rows,
    relative_floor,
)
from semiparam_ros.report.html import inline_svg
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate
from support.arms import ODD_BODY, icub, smooth_motion
from support.browser import check_that_it_stands_alone, is_dark

SAMPLES = 700
TITLE = 'a<b&c.mcap'


def recording(*kinds_hidden, outputs='wrench', seed=1, **options):
    effects = tuple(EffectRequest(kind, **options) for kind in kinds_hidden)
    return simulate(Scenario(samples=SAMPLES, effects=effects, outputs=outputs, seed=seed))


def diagnosed(simulated, only=(), **options):
    return diagnose(body_of(simulated), samples_of(simulated), only=only, **options)


@pytest.fixture(scope='module')
def drifting():
    """A drift of the sensor, and another recording of the same robot that judges."""
    only = ('sensor_drift', 'sensor_offset', 'viscous_drag')
    return diagnosed(recording('sensor_drift', size=2.0), only, other=('elsewhere.mcap', samples_of(recording())))


@pytest.fixture(scope='module')
def loaded():
    """A payload picked up at 12 s, within a block that fits."""
    only = ('payload', 'sensor_offset', 'external_force')
    return diagnosed(recording('payload', start_s=12.0, size=2.0), only=only)


@pytest.fixture(scope='module')
def rubbing():
    """Viscous friction in the elbow's effort."""
    only = ('viscous_friction', 'coulomb_friction', 'asymmetric_friction')
    return diagnosed(recording('viscous_friction', outputs='effort', where='r_elbow', size=2.0), only=only)


@pytest.fixture(scope='module')
def clean():
    """Nothing is missing."""
    return diagnosed(recording(), only=('viscous_drag',))


def test_values_on_the_page_have_the_digits_that_their_deviations_leave(loaded):
    """Of 1.00463 +- 0.00002 kg the page told 1.005."""
    precise = [replace(loaded.findings[0], parameters={'mass': Quantity(1.00463, 2e-5, 'kg')})]
    cells = '<td class="text">mass</td><td>1.004630</td><td>0.000020</td><td class="text">kg</td>'
    assert cells in page_of(replace(loaded, findings=precise))


def test_what_was_found_again_is_not_said_to_be_dropped(rubbing):
    others = [effect_from_text(text) for text in ('joint_spring@r_elbow', 'joint_spring@r_elbow')]
    step = replace(rubbing.steps[0], dropped=(*rubbing.steps[0].added, *others))
    (said,) = [line for line in text_report(replace(rubbing, steps=[step, *rubbing.steps[1:]])) if 'dropped' in line]
    assert said.endswith('explain it better: joint_spring at r_elbow.')


def test_a_small_error_is_not_told_as_none():
    assert [error_text(value) for value in (0.0, 0.02434, 0.00006, 0.00004)] == ['0.0000', '0.0243', '0.0001', '4e-05']


def test_an_error_that_rises_is_not_said_to_fall(drifting):
    worse = replace(drifting, before=drifting.after, by_step=[drifting.before])
    assert any('the normalised error rises from' in line for line in text_report(worse))
    assert any('the normalised error falls from' in line for line in text_report(drifting))


@pytest.fixture(params=['drifting', 'loaded', 'rubbing', 'clean'])
def any_diagnosis(request):
    return request.getfixturevalue(request.param)


PAGES = {}


def page_of(diagnosis):
    """The page, made once for each diagnosis."""
    if id(diagnosis) not in PAGES:
        PAGES[id(diagnosis)] = diagnosis, diagnosis_page(diagnosis, {}, TITLE)
    return PAGES[id(diagnosis)][1]


def pictures(diagnosis):
    """Over time (here and elsewhere), one for each finding and round, spectrum, outputs, and what is unexplained."""
    structure = diagnosis.structure is not None and diagnosis.structure.significant
    return 3 + (diagnosis.elsewhere is not None) + len(suspicions(diagnosis)) + len(diagnosis.steps) + structure


def test_the_page_opens_without_an_error_in_the_console(browse, loaded):
    document, console = browse(page_of(loaded), '--dump-dom')
    assert console == []
    assert document.count('<svg') == pictures(loaded)


@pytest.mark.parametrize(('flags', 'dark'), [([], False), (['--force-dark-mode'], True)])
def test_the_page_is_light_or_dark_as_the_reader_is(browse, rubbing, tmp_path, flags, dark):
    assert is_dark(browse, page_of(rubbing), tmp_path / 'shot.png', *flags) == dark


def test_every_page_stands_alone(any_diagnosis):
    text = page_of(any_diagnosis)
    assert text.count('<svg') == pictures(any_diagnosis)
    check_that_it_stands_alone(text)
    assert '<h1>a&lt;b&amp;c.mcap' in text
    assert 'nan' not in re.sub(r'<svg.*?</svg>', '', text, flags=re.DOTALL).lower().split()


def test_the_words_stand_at_the_top(any_diagnosis):
    text = html.unescape(page_of(any_diagnosis))
    top = text[:text.index('<main>')]
    for line in text_report(any_diagnosis):
        assert line.strip() in top
    for row in table_rows(any_diagnosis):
        assert f'<td class="text">{row.kind}</td><td class="text">{row.values}</td>' in top
    assert f'Next: {next_step(any_diagnosis)}' in top


def test_the_figures_are_those_of_the_report(any_diagnosis):
    text, result = page_of(any_diagnosis), any_diagnosis.as_dict()
    for side in ('before', 'after'):
        assert f'{result[side]["nmse_mean"]:.3g}' in text
    low, high = result['after']['nmse_mean_interval']
    assert f'{low:.3g} to {high:.3g}' in text
    for row, floor in zip(output_rows(any_diagnosis), result['noise_floor_rmse'], strict=True):
        assert f'{floor:.3g}</td>' in text
        assert row.nmse_interval[0] <= row.nmse[1] <= row.nmse_interval[1]
        assert row.rmse_interval[0] <= row.rmse[1] <= row.rmse_interval[1]


def test_the_same_diagnosis_gives_the_same_page(rubbing):
    assert diagnosis_page(rubbing, {}, TITLE) == page_of(rubbing)


def test_a_page_without_findings_shows_one_curve_alone(clean):
    text = page_of(clean)
    assert clean.verdict == 'nothing_missing'
    assert 'what the effect explains' not in text
    assert 'before and after' not in text
    assert 'To declare them' not in text


def test_what_the_page_declares_is_yaml_whatever_a_joint_is_called(rubbing, monkeypatch):
    """An apostrophe in a name ended the text."""
    strange = [replace(effect, where=f"the arm's {effect.where}") for effect in rubbing.standing]
    monkeypatch.setattr(type(rubbing), 'standing', strange)
    shown = re.search(r'<pre>(effects:.*?)</pre>', diagnosis_page(rubbing, {}, TITLE), re.DOTALL)[1]
    assert yaml.safe_load(html.unescape(shown))['effects'] == [effect_to_text(effect) for effect in strange]


@pytest.mark.filterwarnings('error')
def test_an_output_that_never_changes_where_it_is_judged_stretches_no_axis(clean):
    """matplotlib warned on the terminal of a limit of zero, and ignored it."""
    outputs = clean.after.outputs.copy()
    outputs[:, 2] = 1.0
    constant = replace(clean, before=replace(clean.after, outputs=outputs))
    (panel,) = figures.outputs_of(constant).axes
    (ordinary,) = figures.outputs_of(clean).axes
    assert panel.get_xlim()[0] >= ordinary.get_xlim()[0] > 0.0


def test_what_is_to_be_declared_is_what_the_parameter_file_declares(loaded):
    """A load with its start in the recording: a node that was given the line took it up so many seconds late."""
    [finding] = loaded.findings
    assert finding.effect.start_s is not None
    assert f"<pre>effects:\n- 'payload@{finding.effect.where}'\n</pre>" in page_of(loaded)


def test_the_recording_that_judges_has_a_figure_of_its_own(drifting, loaded):
    assert 'on the recording that judges' in page_of(drifting)
    assert 'elsewhere.mcap' in page_of(drifting)
    assert 'on the recording that judges' not in page_of(loaded)


def test_other_models_have_a_table_when_they_were_judged(clean):
    judged = {'SPK-ML': {'before': {'nmse_mean': 0.5}, 'after': {'nmse_mean': 0.125},
                         'draws': {'before': [0.5, 0.5], 'after': [0.125, 0.51]}}}
    text = diagnosis_page(clean, judged, TITLE)
    assert 'SPK-ML (lower in 1 of 2 draws)</th><td>0.5</td><td>0.125</td>' in text
    assert 'SPK-ML' not in page_of(clean)


def test_every_finding_is_listed_with_its_numbers(loaded):
    finding, text = loaded.findings[0], page_of(loaded)
    name = place(finding.effect.kind, finding.effect.where)
    assert f'{name}<span class="spread">since {finding.effect.start_s:.1f} s</span></th>' in text
    assert finding.parameters
    for name, quantity in finding.parameters.items():
        value, std = rounded(quantity)
        assert f'{name}</td><td>{value}</td><td>{std or "–"}</td>' in text


def test_a_wrong_sign_of_the_wrench_is_shown_with_its_remedy():
    simulated = recording()
    flipped = RigidBody.from_urdf(simulated.urdf, simulated.joint_names, 'wrench', simulated.frame_id, 'action')
    found = diagnose(flipped, samples_of(simulated), only=('viscous_drag',))
    assert found.setup
    assert html.escape(found.setup[0].sentence, quote=True) in page_of(found).replace('&#39;', '&#x27;').replace(
        '&#34;', '&quot;')


def test_findings_that_one_picture_shows_share_it(rubbing):
    both = [rubbing.findings[0], replace(rubbing.findings[0], effect=kinds()['coulomb_friction']('r_elbow', {}))]
    shown = suspicions(replace(rubbing, findings=both))
    assert [len(suspicion.findings) for suspicion in shown] == [2]
    text = page_of(replace(rubbing, findings=both))
    assert 'viscous_friction at r_elbow and coulomb_friction at r_elbow' in text


def test_what_no_kind_explains_has_a_section_with_its_formulas(clean):
    good = Formula('fx', (Summand('abs(dq_r_elbow)', 0.5, 'N s/rad'),), 0.4)
    poor = Formula('fy', (Summand('q_r_elbow^2', 0.1, 'N/rad^2'),), 0.001)
    structure = Structure(0.3, np.array([0.5, 0.1, 0, 0, 0, 0]), True, ('fx', 'fy'),
                          (Dependence('dq_r_elbow', 0.3), Dependence('time', 0.1)), (good, poor), {})
    text = page_of(replace(clean, structure=structure, verdict='unexplained'))
    assert 'Something is missing that none of the known effects explains.' in text
    assert html.unescape(text).count('terms@fx{"abs(dq_r_elbow)": 0.5}') == 1
    assert 'terms@fy' not in text
    assert '<code>q_r_elbow^2</code>' in text
    assert 'mean of the last third' in text
    alone = replace(structure, variables=(Dependence('time', 0.3),))
    assert 'mean of the last third' not in page_of(replace(clean, structure=alone))


# --- against what a residual is drawn ---

MOTION = smooth_motion(4, 200)
MOTION = replace(MOTION, temperature=30.0 + MOTION.time[:, None] * np.ones(4))
BODIES = {'wrench': icub(), 'effort': ODD_BODY}
LABELS = {
    'payload': 'time', 'sensor_drift': 'time', 'thermal_drift': 'time', 'sensor_offset': 'time',
    'viscous_friction': 'velocity of', 'coulomb_friction': 'velocity of', 'stribeck_friction': 'velocity of',
    'asymmetric_friction': 'velocity of', 'load_friction': 'velocity of', 'rotor_inertia': 'acceleration of',
    'joint_spring': 'position of', 'transmission_ripple': 'position of', 'backlash': 'position of',
    'tool_exchange': 'time', 'base_shift': 'position of', 'zero_slip': 'position of',
    'joint_offset': 'position of', 'gravity_tilt': 'position of', 'cable_spring': 'position of',
    'cable_hysteresis': 'position of', 'external_force': 'position of', 'effort_offset': 'time',
    'effort_gain': 'predicted', 'common_gain': 'predicted', 'sensor_nonlinearity': 'predicted',
    'gear_coupling': 'position of', 'sensor_gain': 'predicted', 'sensor_crosstalk': 'predicted',
    'sensor_misalignment': 'predicted', 'time_delay': 'rate of change', 'periodic_disturbance': 'phase',
    'viscous_drag': 'velocity of', 'quadratic_drag': 'velocity of', 'temperature_drift': 'temperature of',
    'temperature_friction': 'velocity of'}


def state_of(outputs):
    body = BODIES[outputs]
    exact = replace(MOTION, outputs=body.regressors(MOTION) @ body.base_parameters)
    return fit_model(body, exact, [], np.ones(len(MOTION), dtype=bool), np.ones(body.n_outputs))


@pytest.mark.parametrize(('kind', 'outputs'), [(kind, kinds()[kind].outputs[0]) for kind in LABELS])
def test_every_kind_is_drawn_against_its_own_variable(kind, outputs):
    fit = state_of(outputs)
    where = kinds()[kind].permitted(fit.body)[-1]
    variable = suspected_variable(kinds()[kind](where, {}), fit, MOTION.position[:, 1], 0)
    assert variable.label.startswith(LABELS[kind])
    assert variable.label.endswith(']')
    assert variable.values.shape == (len(MOTION),)
    assert np.ptp(variable.values) > 0.0
    if where in fit.body.joints and LABELS[kind].endswith('of'):
        assert where in variable.label


def test_what_no_kind_explains_is_drawn_in_the_units_of_the_joint():
    names = ('q_lift', 'ddq_turn')
    structure = Structure(0.3, np.full(4, 0.3), True, variables=tuple(Dependence(name, 0.3) for name in names))
    figure, _ = against_unexplained(state_of('effort'), structure)
    assert [panel.get_xlabel() for panel in figure.axes] == ['position of lift [m]', 'acceleration of turn [rad/s²]']


def test_all_listed_kinds_have_a_variable_of_their_own():
    assert set(LABELS) == set(kinds()) - {'terms', 'velocity_filter'}


def test_what_starts_is_drawn_against_time():
    effect = kinds()['external_force']('r_hand', span=Span(3.0))
    assert suspected_variable(effect, state_of('wrench'), MOTION.position[:, 1], 0).label == 'time [s]'


@pytest.mark.parametrize(('axis', 'label'), [('any', 'velocity of r_shoulder_yaw [rad/s]'), ('time', 'time [s]'),
                                             ('position', 'position of r_shoulder_yaw [rad]')])
def test_a_kind_of_another_package_is_drawn_against_what_it_says_or_follows(axis, label):
    class Own(Effect):
        kind = 'own'
        shows_against = axis

    explained = np.abs(MOTION.velocity[:, 2])
    effect = Own('r_shoulder_yaw' if axis == 'position' else None)
    variable = suspected_variable(effect, state_of('wrench'), explained, 0)
    assert variable.label == label
    assert suspected_variable(kinds()['joint_offset']('r_elbow'), state_of('wrench'), explained, 0).label == \
        'position of r_elbow [rad]'


def test_dependence_is_the_share_of_the_variance_that_a_variable_explains():
    rng = np.random.default_rng(0)
    x, noise = rng.uniform(-1, 1, 20_000), rng.standard_normal(20_000)
    assert dependence(x, np.sin(5 * x)) > 0.98
    assert dependence(x, noise) < 0.01
    assert dependence(x, np.sqrt(3.0) * x + noise) == pytest.approx(0.5, abs=0.02)
    assert dependence(x, np.ones_like(x)) == 0.0


def test_velocities_of_a_link_are_along_the_sensor(loaded):
    """A drag is the straight line of its own velocity, whatever the wrench's convention."""
    for convention in ('action', 'reaction'):
        body = icub(convention=convention)
        fit = replace(state_of('wrench'), body=body)
        columns, _ = kinds()['viscous_drag']('r_hand', {}).columns(body, MOTION, None)
        explained = columns[:, 1, 0]
        variable = suspected_variable(kinds()['viscous_drag']('r_hand', {}), fit, explained, 1)
        assert abs(np.corrcoef(variable.values, explained)[0, 1]) > 0.999
        assert variable.label.endswith("along the sensor's y [m/s]")


# --- what the figures hold ---

def test_white_noise_has_power_one_and_a_sine_its_peak():
    rng, step = np.random.default_rng(1), 0.05
    time = step * np.arange(8000)
    floor = np.array([0.3, 2.0])
    frequency, power = figures.relative_power(floor * rng.standard_normal((8000, 2)), step, floor)
    assert power.mean(axis=0) == pytest.approx([1.0, 1.0], abs=0.06)
    assert frequency[0] > 0.0
    assert frequency[-1] == pytest.approx(10.0)
    _, shaken = figures.relative_power(np.sin(2 * np.pi * 3.0 * time)[:, None], step, floor[:1])
    assert frequency[np.argmax(shaken)] == pytest.approx(3.0, abs=0.1)


def test_the_envelope_keeps_every_extreme():
    values = np.random.default_rng(2).standard_normal(5000)
    values[1234] = 50.0
    centre, low, high = figures.envelope(np.arange(5000.0), values)
    assert len(centre) == len(low) == len(high) == figures.MOST_COLUMNS
    assert (high.max(), low.min()) == (values.max(), values.min())
    assert centre[np.argmax(high)] == pytest.approx(1234, abs=14)
    assert len(figures.envelope(np.arange(5.0), np.arange(5.0))[0]) == 1


def test_a_few_outliers_do_not_stretch_an_axis():
    values = np.random.default_rng(3).standard_normal(5000)
    values[:3] = 1000.0
    low, high = figures.limits(values, 2.0 * values)
    assert 5.0 < high < 12.0
    assert -12.0 < low < -5.0


def test_the_bars_are_the_ranking_with_the_chosen_one_marked(loaded):
    step = loaded.steps[0]
    drawn = figures.candidates_of(step, 1).axes[0]
    names = [label.get_text() for label in drawn.get_yticklabels()]
    lengths = [bar.get_width() for bar in drawn.patches]
    colours = {name: to_hex(bar.get_facecolor()) for name, bar in zip(names, drawn.patches, strict=True)}
    assert lengths == sorted(lengths, reverse=True)
    assert lengths == [trial.evidence for trial in figures.foremost(step)]
    assert [name for name, colour in colours.items() if colour == figures.CHOSEN] == [
        f'payload at {effect.where}' for effect in step.added]


def test_what_was_added_is_shown_however_far_down_it_ranked():
    def trial(number, evidence):
        effect = kinds()['viscous_friction'](f'joint{number}', {})
        return Trial(effect, 1, np.zeros(1), evidence=evidence)

    ranking = tuple(trial(number, 100.0 - 10.0 * number) for number in range(12))
    step = Step(added=(ranking[0].effect, ranking[11].effect), rivals=(Rival(ranking[3].effect, 0.5),),
                ranking=ranking, before=None, after=None)
    shown = figures.foremost(step)
    assert shown == list(ranking[:figures.MOST_BARS])  # nothing is shown that explains nothing
    better = tuple(replace(each, evidence=each.evidence + 50.0) for each in ranking)
    step = replace(step, added=(better[0].effect, better[11].effect), ranking=better)
    assert figures.foremost(step) == [*better[:figures.MOST_BARS], better[11]]
    bars = figures.candidates_of(step, 2).axes[0].patches
    assert [to_hex(bar.get_facecolor()) for bar in bars] == [
        figures.CHOSEN, *[figures.OTHER] * 2, figures.RIVAL, *[figures.OTHER] * 5, figures.CHOSEN]


def test_dollars_in_the_name_of_a_joint_are_no_formula():
    """$q_$ was an internal error after minutes of work, and ${left}${hand} was drawn without its dollars."""
    effect = kinds()['viscous_friction']('$q_$', {})
    step = Step(added=(effect,), rivals=(), ranking=(Trial(effect, 1, np.zeros(1), evidence=9.0),), before=None,
                after=None)
    time, name = 0.1 * np.arange(30), 'residual of $q_$ [N m]'
    shown = figures.curves(np.zeros((30, 1)), time[:, None], added=True)
    for figure in (figures.candidates_of(step, 1),
                   figures.over_time(time, shown, [name], time > 2.0, [('viscous_friction at $q_$', 1.0)])):
        assert '$q_$' in inline_svg(figure, 'one', 'a figure')


# --- what the tables hold ---

@pytest.mark.parametrize(('odds', 'expected'), [
    (1.0, '1.0 : 1'), (24.3, '24 : 1'), (0.05, '1 : 20'), (0.4, '1 : 2.5'), (5000.0, 'over 1000 : 1'),
    (1e-9, 'under 1 : 1000'), (1e-300, 'under 1 : 1000')])
def test_odds_are_written_as_people_say_them(odds, expected):
    assert odds_text(odds) == expected


def test_intervals_of_independent_errors_are_those_of_the_mean(clean):
    """For white errors of deviation s the mean square has a relative error of sqrt(2 / N)."""
    rng = np.random.default_rng(4)
    evaluation = replace(clean.after, residual=3.0 * rng.standard_normal((20_000, 6)),
                         outputs=rng.standard_normal((20_000, 6)), counted=np.ones((20_000, 6), dtype=bool))
    bounds = evaluation.square_intervals()
    assert bounds.shape == (6, 2)
    width = 9.0 * np.sqrt(2.0 / 20_000) * 2 * 1.96
    assert np.mean(bounds[:, 1] - bounds[:, 0]) == pytest.approx(width, rel=0.15)


def test_interval_and_floor_are_over_the_variance_of_what_counts(rubbing):
    """As the error is: of a joint at rest half of the time they were over that of all its efforts."""
    counted = np.ones_like(rubbing.after.counted)
    counted[rubbing.after.outputs > np.median(rubbing.after.outputs, axis=0)] = False
    evaluation = replace(rubbing.after, counted=counted)
    diagnosis = replace(rubbing, before=evaluation, by_step=[evaluation] * len(rubbing.by_step))
    for row, floor in zip(output_rows(diagnosis), relative_floor(diagnosis), strict=True):
        over = row.rmse[1] ** 2 / row.nmse[1]
        np.testing.assert_allclose(row.nmse_interval, np.square(row.rmse_interval) / over)
        assert floor == pytest.approx(row.floor**2 / over)


def test_the_noise_floor_is_relative_to_each_output(clean):
    expected = clean.noise_floor_rmse**2 / clean.after.outputs.var(axis=0)
    np.testing.assert_allclose(relative_floor(clean), expected)


def test_samples_that_judge_one_by_one_have_no_noise_floor(clean):
    """Every third one held out of a fit: no run of them is long enough for a third difference."""
    alone = replace(clean, before=replace(clean.before, parts=tuple(pairwise(range(len(clean.before.residual) + 1)))))
    assert alone.noise_floor_rmse.tolist() == [row.floor for row in output_rows(alone)] == 6 * [0.0]
