"""The coupled columns: blocks in order, and one sample at a time equal to all at once, also with effects' memories."""

from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.columns import ColumnBlock, CoupledColumns
from semiparam_ros.core.robot.rigid_body import RigidBody
from semiparam_ros.effects.geometry import BaseShift
from support.arms import ODD_BODY, icub, smooth_motion


class Nothing(ColumnBlock):
    """An effect without effect: what the others here start from."""

    scale = np.zeros(0)

    def prior_scale(self, body):
        return self.scale


class Drift(Nothing):
    """Grows with the time since the origin: needs the origin, but no memory."""

    scale = np.full(6, 5.0)

    def columns(self, body, samples, memory):
        return samples.time[:, None, None] * np.eye(6), None


class Travel(Nothing):
    """The distance that the joints have gone so far: remembers where they were and how far it was."""

    scale = np.ones(6)

    def columns(self, body, samples, memory):
        distance, last = (0.0, samples.position[0]) if memory is None else memory
        steps = np.abs(np.diff(samples.position, axis=0, prepend=last[None])).sum(axis=1)
        travelled = distance + np.cumsum(steps)
        return travelled[:, None, None] * np.eye(6), (travelled[-1], samples.position[-1])


class OneSampleLate(Nothing):
    """The encoders report the sample before: inputs move, and the last one is remembered."""

    def correct(self, body, samples, memory):
        before = samples.position[:1] if memory is None else memory
        late = np.concatenate([before, samples.position[:-1]])
        return body, replace(samples, position=late), samples.position[-1:]


class Gain(Nothing):
    """One channel reads too much."""

    def transform(self, body, regressors):
        return regressors * np.array([1, 1, 1.2, 1, 1, 1])[:, None]


class Tilt(Nothing):
    """Gravity points elsewhere and the first joint's zero is off."""

    def correct(self, body, samples, memory):
        position = samples.position + np.array([0.1, 0, 0, 0])
        return body.with_gravity(np.array([1.0, 0.0, -9.7])), replace(samples, position=position), None


MOTION = smooth_motion(4, 30)
SETS = {'none': [], 'drift': [Drift()], 'travel': [Travel()], 'late': [OneSampleLate()], 'tilt': [Tilt()],
        'gain': [Gain()], 'all': [Tilt(), Travel(), Gain(), OneSampleLate(), Drift()]}


@pytest.fixture(scope='module')
def body():
    return icub()


@pytest.mark.parametrize('effects', [SETS['all'], [Tilt(), BaseShift()]])
def test_a_live_sample_builds_no_model_of_the_robot_anew(body, monkeypatch, effects):
    columns, (first, *others) = CoupledColumns(body, effects), MOTION
    _, memory = columns.one(first, MOTION.origin)
    monkeypatch.setattr(RigidBody, '_make_data', lambda body: pytest.fail('it takes longer than all the rest'))
    for sample in others:
        _, memory = columns.one(sample, MOTION.origin, memory)


@pytest.mark.parametrize('name', SETS)
@pytest.mark.parametrize('pieces', [[30], [1] * 30, [7, 1, 22]])
def test_samples_in_pieces_equal_all_at_once(body, name, pieces):
    columns = CoupledColumns(body, SETS[name])
    expected, _ = columns.batch(MOTION)
    assert expected.shape == (30, 6, columns.n_columns)
    found, memory, start = [], None, 0
    for size in pieces:
        part = MOTION[start:start + size]
        if size == 1:
            one, memory = columns.one(next(iter(part)), part.origin, memory)
            found.append(one[None])
        else:
            many, memory = columns.batch(part, memory)
            found.append(many)
        start += size
    np.testing.assert_allclose(np.concatenate(found), expected, rtol=0, atol=1e-12)


def test_blocks_stand_in_their_order(body):
    columns = CoupledColumns(body, [Drift(), Nothing(), Travel()])
    p = body.n_parameters
    assert columns.blocks == {'rigid_body': slice(0, p), 'friction': slice(p, p), 'rotor': slice(p, p),
                              'offset': slice(p, p + 6),
                              '0': slice(p + 6, p + 12), '1': slice(p + 12, p + 12), '2': slice(p + 12, p + 18)}
    assert columns.n_columns == p + 18
    stacked, _ = columns.batch(MOTION)
    np.testing.assert_array_equal(stacked[:, :, columns.blocks['rigid_body']], body.regressors(MOTION))
    np.testing.assert_array_equal(stacked[3, :, columns.blocks['offset']], np.eye(6))
    np.testing.assert_array_equal(stacked[3, :, columns.blocks['0']], MOTION.time[3] * np.eye(6))


def test_the_prior_is_wide_for_an_offset_and_centred_on_the_description(body):
    columns = CoupledColumns(body, [Drift()])
    scale, mean, blocks = columns.prior_scale, columns.prior_mean, columns.blocks
    np.testing.assert_array_equal(scale[blocks['rigid_body']], 1.0)
    assert (scale[blocks['offset']] >= 30.0).all()
    np.testing.assert_array_equal(scale[blocks['0']], 5.0)
    np.testing.assert_array_equal(mean[blocks['rigid_body']], body.base_parameters)
    np.testing.assert_array_equal(mean[body.n_parameters:], 0.0)


def test_efforts_have_no_offset_of_their_own():
    columns = CoupledColumns(ODD_BODY)
    assert columns.n_columns == ODD_BODY.n_parameters
    assert columns.blocks['offset'] == slice(ODD_BODY.n_parameters, ODD_BODY.n_parameters)


def test_time_starts_at_the_origin_that_one_is_told(body):
    columns = CoupledColumns(body, [Drift()])
    sample = next(iter(MOTION))
    late, _ = columns.one(sample._replace(stamp=5_000_000_000), origin=2_000_000_000)
    np.testing.assert_allclose(late[:, columns.blocks['0']], 3.0 * np.eye(6))
