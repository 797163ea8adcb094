"""`semiparam bench`: the contenders compute what they claim, and the command reports them side by side."""

import json

import numpy as np
import pytest

from semiparam_ros.cli import main as cli
from semiparam_ros.cli.bench import MEANING
from semiparam_ros.experiments.benchmark import SIGMA, Covariance, Dense, Potter

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
    path = tmp_path / 'bench.json'
    assert cli.main(['bench', '--features', '10', '20', '--rounds', '2', '--json', str(path)]) == 0
    document = json.loads(path.read_text())
    assert [row['features'] for row in document['sizes']] == [10, 20]
    assert (document['outputs'], document['inputs'], document['threads']) == (6, 12, 1)
    for row in document['sizes']:
        assert set(row['microseconds']) == set(MEANING)
        assert row['unknowns'] == row['columns'] + 6 * row['features']
        assert 0.0 < row['evidence_seconds'] < 60.0
        assert row['of_potter'] == pytest.approx(row['microseconds']['SPK'] / row['microseconds']['Potter'])
    assert 'dense / SPK' in capsys.readouterr().out


@pytest.mark.parametrize('arguments', [['--features', '11'], ['--rounds', '0'], ['--frame', 'no_such_frame']])
def test_bench_refuses_what_it_cannot_time(arguments, capsys):
    assert cli.main(['bench', *arguments]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
