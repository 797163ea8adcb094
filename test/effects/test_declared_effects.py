"""A declared effect never makes a variant clearly worse."""

import pytest

from semiparam_ros.core.robot.size import plausible, size_beyond, size_of
from semiparam_ros.core.variants import VARIANTS
from support import declared_effects
from support.arms import icub
from support.effect_cases import BODIES


@pytest.mark.parametrize('variant', ['P', pytest.param('SP-ML', marks=pytest.mark.long), 'SP2-VS'])
def test_effects_that_the_window_does_not_excite_do_no_harm(variant, monkeypatch):
    """A load that comes later, and a friction of a joint that turned one way only."""
    monkeypatch.setattr(declared_effects, 'FEATURES', 40)
    name = 'one_way' if variant != 'SP-ML' else 'icub_xy'
    plain = declared_effects.outcome((name, variant, None))
    kinds = ('payload', 'asymmetric_friction')
    tried = [effect for effect in declared_effects.declared(name, kinds)
             if effect.where in ('r_elbow', 'r_gripper') and ('presliding' not in effect.parameters)
             and (effect.start_s is not None) == (effect.kind == 'payload')]
    assert tried
    for effect in tried:
        found = declared_effects.outcome((name, variant, effect))
        assert declared_effects.harm(found, plain) < declared_effects.MOST_HARM, found


def test_a_late_effect_does_not_take_drift_for_its_own(monkeypatch):
    """With its coefficients taken for certain, 1.27 times the error without it."""
    monkeypatch.setattr(declared_effects, 'FEATURES', 40)
    plain = declared_effects.outcome(('drifting', 'SP-ML', None))
    *_, late = declared_effects.declared('drifting', ('external_force',))
    assert late.start_s is not None and late.where == 'r_hand'
    assert declared_effects.harm(declared_effects.outcome(('drifting', 'SP-ML', late)), plain) < 1.05


@pytest.mark.long
@pytest.mark.parametrize('variant', VARIANTS)
@pytest.mark.parametrize('name', [*declared_effects.RECORDINGS, *declared_effects.MEASURED_RECORDINGS])
def test_no_effect_does_harm_to_any_variant(name, variant, request):
    if name in declared_effects.MEASURED_RECORDINGS:
        request.getfixturevalue('shared_data')
    plain = declared_effects.outcome((name, variant, None))
    found = [declared_effects.outcome((name, variant, effect)) for effect in declared_effects.declared(name)]
    harmful = [each for each in found if declared_effects.harm(each, plain) > declared_effects.MOST_HARM]
    assert not harmful, (plain, harmful)


def test_what_is_plausible_follows_the_robots_size():
    wrench, effort = icub(), BODIES['effort']
    size = size_of(wrench)
    assert size.mass == pytest.approx(1.54, abs=0.01) and size.length == pytest.approx(0.285, abs=0.01)
    assert plausible('kg', size) == pytest.approx(0.2 * size.mass)
    assert plausible('kg m^2', size) == pytest.approx(0.2 * size.mass * size.length**2)
    assert plausible('N m s/rad', size) == plausible('N m', size) == pytest.approx(0.2 * size.weight * size.length)
    assert plausible('N s^2/m^2', size) == pytest.approx(0.2 * size.weight / size.length**2)
    assert plausible('', size) == 1.0
    beyond = [size_beyond(effort, joint).mass for joint in effort.joints]
    assert beyond == sorted(beyond, reverse=True) and beyond[-1] < beyond[0] == size_of(effort).mass
