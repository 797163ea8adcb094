"""A learner whose arm has just picked something up, seen once for all tests that begin with it."""

from copy import deepcopy
from functools import cache

from support.changing_arm import LOADED_S, loaded, offered
from support.learner_stage import Stage


def begun(seconds: float, **settings: object) -> Stage:
    """What a learner of the loaded arm is so many seconds after the load came, for the test to go on with."""
    stage = _begun(seconds, tuple(settings.items()))
    return deepcopy(stage, {id(each): each for each in (loaded()[0], *stage.answers)})


@cache
def _begun(seconds: float, settings: tuple[tuple[str, object], ...]) -> Stage:
    body, samples, _ = loaded()
    return offered(body, samples[samples.time < LOADED_S[0] + seconds], **dict(settings))
