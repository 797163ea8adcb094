"""`semiparam bench`: the contenders compute what they claim, and the command reports them side by side."""

import numpy as np
import pytest

from semiparam_ros.cli.bench import MEANING
from semiparam_ros.experiments.benchmark import SIGMA, Covariance, Dense, Potter
from semiparam_ros.experiments.scoreboard import samples_of
from semiparam_ros.settings import Settings
from semiparam_ros.simulation.scenario import EffectRequest, Scenario
from semiparam_ros.simulation.simulate import simulate
from support.commands import document, refusal
from support.recordings import write_arm

COLUMNS, FEATURES, OUTPUTS, SAMPLES = 4, 6, 3, 20


@pytest.fixture
def samples():
    rng = np.random.default_rng(3)
    return [(rng.normal(size=(OUTPUTS, COLUMNS)), rng.normal(size=FEATURES), rng.normal(size=OUTPUTS))
            for _ in range(SAMPLES)]


@pytest.mark.parametrize('together', [False, True])
def test_dense_equals_the_batch_solution(samples, together):
    dense = Dense(COLUMNS, FEATURES, OUTPUTS, together)
    for columns, phi, outputs in samples:
        dense.update(columns, phi, outputs)
    rows = np.vstack([np.hstack([columns, np.kron(phi, np.eye(OUTPUTS))]) for columns, phi, _ in samples])
    outputs = np.concatenate([outputs for _, _, outputs in samples])
    batch = np.linalg.solve(rows.T @ rows + SIGMA**2 * np.eye(rows.shape[1]), rows.T @ outputs)
    np.testing.assert_allclose(dense.unknowns, batch, rtol=1e-10, atol=1e-12)


def test_the_updates_alone_give_the_posterior_covariance(samples):
    covariance, potter = Covariance(FEATURES), Potter(FEATURES)
    for _, phi, _ in samples:
        covariance.update(phi)
        potter.update(phi)
    phis = np.array([phi for _, phi, _ in samples])
    posterior = np.linalg.inv(np.eye(FEATURES) + phis.T @ phis / SIGMA**2)
    upper = np.triu(covariance._covariance)
    np.testing.assert_allclose(upper + np.triu(upper, 1).T, posterior, atol=1e-10)
    np.testing.assert_allclose(potter._root @ potter._root.T, posterior, atol=1e-10)


def test_bench_reports_every_contender_side_by_side(tmp_path, capsys):
    found = document(tmp_path / 'bench.json', 'bench', '--features', 10, 20, '--rounds', 2)
    assert [row['features'] for row in found['sizes']] == [10, 20]
    assert (found['outputs'], found['inputs'], found['threads']) == (6, 12, 1)
    for row in found['sizes']:
        assert set(row['microseconds']) == set(MEANING)
        assert row['unknowns'] == row['columns'] + 6 * row['features']
        assert 0.0 < row['evidence_seconds'] < 60.0
        assert row['of_potter'] == pytest.approx(row['microseconds']['SPK'] / row['microseconds']['Potter'])
    assert 'dense / SPK' in capsys.readouterr().out


@pytest.mark.parametrize('arguments', [['--features', '11'], ['--rounds', '0'], ['--frame', 'no_such_frame']])
def test_bench_refuses_what_it_cannot_time(arguments, capsys):
    assert refusal(capsys, 'bench', *arguments)


PEERS = ('river BayesianLinearRegression', 'sklearn SGDRegressor', 'sklearn BayesianRidge, batch',
         'sklearn KernelRidge, batch')


def test_peers_get_the_same_samples_as_ours(recording, params, tmp_path, capsys):
    pytest.importorskip('river')
    path, options = tmp_path / 'peers.json', ('--params', params, '--variant', 'P', '--variant', 'SPK-ML')
    found = document(path, 'bench', '--peers', recording, '--features', 20, *options)['learners']
    table = capsys.readouterr().out
    ours = document(path, 'evaluate', recording, *options)['variants']
    for variant, learner in zip(('P', 'SPK-ML'), found, strict=False):
        assert learner['learner'] == variant
        assert learner['nmse'] == pytest.approx(ours[variant]['nmse'], rel=1e-9)
    for peer in PEERS:
        mine = [learner for learner in found if learner['learner'] == peer]
        assert mine and peer in table
        for learner in mine:
            assert learner['microseconds'] > 0.0 and len(learner['nmse']) == 6
            assert learner['nmse_mean'] == pytest.approx(np.mean(learner['nmse']))
    assert max(map(len, table.splitlines()[:-5])) <= 80
    errors = {(learner['learner'], learner['sees']): learner['nmse_mean'] for learner in found}
    assert errors['river BayesianLinearRegression', 'rigid body'] < 0.1, 'the arm is a rigid body'
    assert errors['sklearn BayesianRidge, batch', 'rigid body'] < 0.1


@pytest.mark.parametrize('kind', ['River', 'Sgd', 'RefittedRidge', 'RefittedKernelRidge'])
@pytest.mark.parametrize('seen', ['rigid body', 'features'])
def test_a_peer_learns_what_it_sees(kind, seen):
    peers = pytest.importorskip('semiparam_ros.experiments.peers')
    if (kind, seen) == ('RefittedKernelRidge', 'rigid body'):
        return
    rng = np.random.default_rng(1)
    inputs, columns = rng.normal(size=(600, 6)), rng.normal(size=(600, 2, 3))
    outputs = columns @ [1.0, -2.0, 0.5] if seen == 'rigid body' else 3.0 + np.sin(inputs[:, :2])
    outputs = outputs + 0.01 * rng.normal(size=outputs.shape)
    view = peers.RigidBodyView() if seen == 'rigid body' else peers.InputView() if 'Kernel' in kind else \
        peers.FeatureView(200)
    peer = getattr(peers, kind)(view, 2)
    peer.begin(peers.PeerWindow(inputs[:100], columns[:100], outputs[:100]))
    errors = []
    for index in range(100, 600):
        errors.append(peer.predict(inputs[index], columns[index]) - outputs[index])
        peer.learn(outputs[index])
    late, early = (np.mean(np.square(part)) for part in (errors[-100:], errors[:100]))
    share = {('Sgd', 'rigid body'): 0.1, ('Sgd', 'features'): 1.0}.get(  # slow with its usual steps
        (kind, seen), 0.001 if seen == 'rigid body' else 0.3)
    assert late < share * outputs.var()
    assert seen == 'rigid body' or late < early


@pytest.mark.parametrize('seen', ['RigidBodyView', 'InputView'])
@pytest.mark.filterwarnings('error')
def test_a_peer_of_one_output_is_fitted_without_a_warning(seen):
    """scikit-learn warned at each fit."""
    peers = pytest.importorskip('semiparam_ros.experiments.peers')
    rng = np.random.default_rng(1)
    inputs, columns = rng.normal(size=(60, 6)), rng.normal(size=(60, 1, 3))
    outputs = columns @ [1.0, -2.0, 0.5] if seen == 'RigidBodyView' else inputs[:, :1]
    peer = peers.RefittedRidge(getattr(peers, seen)(), 1)
    peer.begin(peers.PeerWindow(inputs[:50], columns[:50], outputs[:50]))
    assert [peer.predict(inputs[50], columns[50]).item()] == pytest.approx(outputs[50], abs=0.01)


@pytest.mark.parametrize(('arguments', 'sentence'), [
    (['--features', '20', '40'], '--features holds 2 numbers; expected one with --peers'),
    (['--variant', 'X'], "variant 'X' is unknown")])
def test_peers_refuse_what_makes_no_sense(arguments, sentence, recording, params, capsys):
    pytest.importorskip('river')
    assert sentence in refusal(capsys, 'bench', '--peers', recording, '--params', params, *arguments)


def test_a_recording_hardly_longer_than_its_window_is_refused(params, tmp_path, capsys):
    pytest.importorskip('river')
    short = write_arm(tmp_path / 'short.mcap', 120)
    assert 'expected at least 50 more' in refusal(capsys, 'bench', '--peers', short, '--params', params)


@pytest.mark.long
def test_peers_get_friction_and_offsets_of_joints_as_ours():
    """They had the bare rigid body: errors of 0.080 where ours had 0.007."""
    peers = pytest.importorskip('semiparam_ros.experiments.peers')
    hidden = [EffectRequest(kind, joint) for joint in ('r_elbow', 'r_shoulder_pitch')
              for kind in ('coulomb_friction', 'effort_offset')]
    found = simulate(Scenario(samples=800, outputs='effort', motion='mixed', effects=tuple(hidden), seed=1))
    settings = Settings(outputs='effort', joints=found.joint_names, initial_samples=400, features_count=2)
    ours, theirs, *_ = peers.compare_with_peers(settings, samples_of(found), found.urdf, ['P'], lambda: None)
    assert theirs.sees == ours.sees == 'rigid body' and theirs.nmse_mean < 2.0 * ours.nmse_mean
