"""The long run of benchmarks/, with fewer samples: flat, finite, and the batch solution."""

import json
import subprocess
import sys

import numpy as np
import pytest


@pytest.fixture(scope='module')
def runs(repository, tmp_path_factory):
    """Every run of the command, by variant and forgetting."""
    path = tmp_path_factory.mktemp('long_run') / 'figures.json'
    subprocess.run([sys.executable, 'benchmarks/long_run.py', '--samples', '8000', '--json', path], cwd=repository,
                   check=True, capture_output=True, timeout=250)
    return {(figures['variant'], figures['forgetting']): figures for figures in json.loads(path.read_text())['runs']}


def test_every_run_is_finite_and_its_memory_flat(runs):
    assert runs.keys() == {('P', 1.0), ('P', 0.998), ('SPK-ML', 1.0), ('SPK-ML', 0.998)}
    for case, figures in runs.items():
        resident = [entry['resident_mb'] for entry in figures['memory']]
        assert figures['finite'] and figures['samples'] == 8000, case
        assert len(resident) == 10 and np.ptp(resident[1:]) < 2.0, case
        assert figures['rmse_last_cycle'] < 0.5, case


@pytest.mark.parametrize('variant', ['P', 'SPK-ML'])
def test_without_forgetting_a_run_ends_at_the_batch_solution(runs, variant):
    found = runs[variant, 1.0]['relative_difference']
    assert (found['alpha'] is None) == (variant == 'P')
    assert all(value < 1e-10 for value in found.values() if value is not None), found
