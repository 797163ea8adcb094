"""Every pair of settings: some rows with a few hundred samples, or all with 20000."""

import pytest

pytest.importorskip('covertable')
from semiparam_ros.core.variants import AVERAGED, CHOICES
from semiparam_ros.effects import effect_to_text, kinds
from semiparam_ros.effects.base import TIMES
from semiparam_ros.errors import SemiparamError
from semiparam_ros.online.model_jobs import new_estimator
from support import settings_matrix as matrix

SAMPLES = 330


def test_every_pair_of_settings_is_in_a_row_and_only_the_listed_ones_are_left_out():
    tested = set().union(*map(matrix.pairs_of, matrix.rows()))
    assert tested == matrix.possible_pairs()
    assert len(tested) > 1500 and all(map(matrix.is_possible, matrix.rows()))


@pytest.mark.parametrize('name', kinds())
def test_an_effect_with_all_of_its_values_has_them_all(name):
    kind = kinds()[name]
    for outputs in kind.outputs:
        for place in ('first', 'last') if name != 'terms' else ():
            effect = matrix.effect_of({'effect': name, 'outputs': outputs, 'values': 'all', 'times': 'none',
                                       'place': place}, 3.0)
            assert {*effect.values, *TIMES} >= set(kind.value_names()) - set(kind.option_names)


@pytest.mark.parametrize(('effect', 'factor', 'value'), matrix.IMPOSSIBLE)
def test_an_impossible_pair_is_refused_with_a_sentence(effect, factor, value):
    possible = {'effect': effect, 'outputs': kinds()[effect].outputs[0], 'values': 'bare', 'times': 'none',
                'place': 'last'}
    outputs = value if factor == 'outputs' else possible['outputs']
    declared = matrix.effect_of(possible if factor == 'outputs' else possible | {factor: value}, 3.0)
    settings = matrix.settings_of({**matrix.rows()[0], 'effect': 'none', 'outputs': outputs}, SAMPLES)
    settings = settings.changed({'effects': [effect_to_text(declared)]})
    with pytest.raises(SemiparamError, match=f"effect '{effect}' {matrix.IMPOSSIBLE[effect, factor, value]}"):
        new_estimator(settings, matrix.body_of(outputs))


@pytest.mark.parametrize('variant', CHOICES)
def test_live_offline_and_loaded_are_the_same_and_finite(variant, long):
    mine = [row for row in matrix.rows() if row['variant'] == variant]
    assert len(mine) > 20
    # The first rows have most of the pairs. An average costs its members' time.
    for row in mine[:None if long else 5 if variant == AVERAGED else 8]:
        print(row)
        matrix.check(row, 20_000 if long else SAMPLES)
