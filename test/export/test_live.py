"""Parameters of a running node as bodies that can be."""

import json
from dataclasses import replace

import numpy as np
import pytest

from semiparam_ros.core.robot.consistency import (
    Body,
    ball,
    consistent_bodies,
    inertial_parameters,
    is_consistent,
    pseudo_inertia,
)
from semiparam_ros.core.robot.frames import load_regressor
from semiparam_ros.core.samples import Samples
from semiparam_ros.errors import SemiparamError
from semiparam_ros.export.estimate import from_estimator
from semiparam_ros.export.identified import identified_load
from semiparam_ros.export.live import consistent_parameters
from semiparam_ros.online.model_jobs import known_of
from semiparam_ros.settings.build import build_estimator, hyperparameter_values
from support.node_helpers import BODY, SETTINGS, URDF, motion


def parameters(link):
    """(10,) from a link of the document: mass, centre, inertia about it."""
    mass, centre, about = link['mass'], np.array(link['centre']), np.array(link['inertia'])
    inertia = about + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.r_[mass, mass * centre, inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]]


@pytest.fixture(scope='module')
def learnt():
    """An estimate from outputs that no bodies bring about: moments of inertia below zero."""
    estimator = build_estimator(replace(SETTINGS, variant='P'))
    rng = np.random.default_rng(0)
    wrong = BODY.inertial_parameters.copy().reshape(-1, 10)
    wrong[:, [4, 6, 9]] -= 0.05
    wrong = BODY.basis.T @ wrong.ravel()
    for sample in motion(300):
        row = sample.position, sample.velocity, sample.acceleration
        outputs = BODY.regressor(*row) @ wrong + 0.05 * rng.standard_normal(6)
        estimator.step(sample._replace(outputs=outputs))
    return from_estimator(estimator, None, 'a node')


def test_a_model_of_given_hyperparameters_that_has_learnt_nothing_is_refused():
    """It was an internal error once a second, of a maximum over no speeds."""
    estimator = build_estimator(replace(SETTINGS, variant='P'))
    for sample in motion(100):
        estimator.step(sample)
    given = replace(SETTINGS, variant='P').changed(hyperparameter_values(*known_of(estimator)[:3]))
    with pytest.raises(SemiparamError, match='a node has learnt no sample yet'):
        from_estimator(build_estimator(given), None, 'a node')


def gap(estimate, theta):
    """Half the squared distance [nat] from what was learnt, in its standard deviations."""
    apart = theta - estimate.mean
    return 0.5 * apart @ estimate.information @ apart


def test_links_can_be_and_their_coefficients_are_as_near_as_the_estimate_allows(learnt):
    found = consistent_parameters(URDF, learnt, None)
    links = json.loads(found.document)['links']
    assert links and all(np.linalg.eigvalsh(pseudo_inertia(parameters(link))).min() > 0.0
                         for link in links.values())
    assert found.load is None and found.seconds > 0.0
    rigid, described = learnt.columns.blocks['rigid_body'], BODY.base_parameters
    rest = np.setdiff1d(np.arange(len(learnt.mean)), np.arange(rigid.start, rigid.stop))
    for share in (0.0, 0.5, 0.9):  # towards the description bodies can be, too
        other = found.theta.copy()
        other[rigid] = share * found.theta[rigid] + (1.0 - share) * described
        pull = learnt.information[np.ix_(rest, range(rigid.start, rigid.stop))]
        other[rest] = learnt.mean[rest] - np.linalg.solve(
            learnt.information[np.ix_(rest, rest)], pull @ (other - learnt.mean)[rigid])
        assert gap(learnt, found.theta) < gap(learnt, other)


@pytest.mark.parametrize('radius', [0.01, 0.1])
def test_a_body_that_is_known_is_found_however_small_its_reference_is(radius):
    body = inertial_parameters(0.5 * np.array([
        [0.02, 0.0, 0.02, 0.1], [0.0, 0.01, 0.0, 0.0], [0.02, 0.0, 0.05, 0.2], [0.1, 0.0, 0.2, 1.0]]))
    found = consistent_bodies(body, 1e6 * np.eye(10), [Body(ball(0.1, radius), np.eye(10))])[0]
    np.testing.assert_allclose(found, body, atol=1e-6)


def test_a_load_that_can_be_stays_and_another_moves_by_what_is_not_known_of_it():
    body = inertial_parameters(0.5 * np.array([
        [0.02, 0.0, 0.02, 0.1], [0.0, 0.01, 0.0, 0.0], [0.02, 0.0, 0.05, 0.2], [0.1, 0.0, 0.2, 1.0]]))
    assert is_consistent(body)
    near = identified_load(BODY, body, 1e-12 * np.eye(10))
    np.testing.assert_allclose(near, body, atol=1e-5)
    point = np.r_[body[:4], np.zeros(6)]  # its inertia about its centre is below zero
    std = np.r_[[1e-4] * 4, [0.05] * 6]
    found = identified_load(BODY, point, np.diag(std**2))
    assert not is_consistent(point) and is_consistent(found)
    assert (np.abs(found - point) < 4.0 * std).all()


def test_a_load_far_from_its_link_is_exported_where_it_is():
    """Of a sensor at the wrist the arm's length is that of the whole arm, not what is beyond it."""
    inertia = 0.5 * np.array([[0.02, 0.0, 0.0, 0.1], [0.0, 0.01, 0.0, 0.0],
                              [0.0, 0.0, 0.05, 0.2], [0.1, 0.0, 0.2, 1.0]])
    load, rng = inertial_parameters(inertia), np.random.default_rng(1)
    estimator = build_estimator(replace(SETTINGS, variant='P', effects=('payload@ft{"start_s": 6.0}',)))
    samples = Samples.from_list(motion(600))
    weight = load_regressor(BODY, samples, 'ft') @ load * (samples.time >= 6.0)[:, None]
    for sample, own in zip(samples, weight, strict=True):
        row = sample.position, sample.velocity, sample.acceleration
        rigid = BODY.regressor(*row) @ BODY.base_parameters
        estimator.step(sample._replace(outputs=rigid + own + 0.01 * rng.standard_normal(6)))
    found = consistent_parameters(URDF, from_estimator(estimator, None, 'a node'), None)
    told, = json.loads(found.document)['loads']
    assert told['start_s'] == 6.0
    np.testing.assert_allclose(told['mass'], 0.5, rtol=0.05)
    np.testing.assert_allclose(told['centre'], [0.1, 0.0, 0.2], atol=0.02)
