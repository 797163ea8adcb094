"""Every kind of effect at every place, on an arm with a sensor and on one with efforts."""

from dataclasses import replace

import numpy as np

from semiparam_ros.effects import Effect, kinds
from support.arms import ODD_BODY, icub, smooth_motion

MOTION = smooth_motion(4, 40)
MOTION = replace(MOTION, temperature=30.0 + np.where(MOTION.time < 0.3, np.nan, 2.0 * MOTION.time)[:, None]
                 * [1.0, 0.5, -1.0, 2.0])
BODIES = {'wrench': icub(), 'effort': ODD_BODY}
FORMULA = {'wrench': {'time*abs(dq_r_elbow)': 1.2, 'bump(q_r_elbow,0.1,0.3)': 1.0}, 'effort': {'q_elbow^2': 0.3}}
RESIDUALS = {name: np.random.default_rng(0).standard_normal((len(MOTION), body.n_outputs))
             for name, body in BODIES.items()}


def everywhere() -> list[tuple[str, Effect]]:
    """(outputs, effect) for every kind at every place, with the first values that a search would try."""
    cases = []
    for outputs, body in BODIES.items():
        for kind in kinds(outputs).values():
            for where in kind.places(body):
                values = kind.searches(body, MOTION, where, RESIDUALS[outputs])[0]
                cases.append((outputs, kind.from_values(where, values, tuple(body.base_parameters))))
        cases.append((outputs, kinds()['terms'](body.output_names[0], FORMULA[outputs])))
        cases.append((outputs, kinds()['velocity_filter']()))  # no search tries it
    cases.append(('effort', kinds()['coulomb_friction']('elbow', {'turn_speed': 0.02, 'lead_s': 0.01})))
    return cases


CASES = everywhere()
NAMES = [f'{outputs}-{effect.kind}@{effect.where}' for outputs, effect in CASES]
