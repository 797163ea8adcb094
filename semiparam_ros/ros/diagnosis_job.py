"""What the background process does for ``~/diagnose``; nothing here knows ROS."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from semiparam_ros.core.rigid_body import RigidBody
from semiparam_ros.core.samples import Samples

if TYPE_CHECKING:
    from semiparam_ros.diagnosis.diagnose import Diagnosis

SAMPLES_AT_MOST = 6000


class Outcome(NamedTuple):
    """A diagnosis in words and as the machine-readable report; ``effects`` are all that the model then declares."""

    verdict: str
    words: list[str]
    report: dict[str, Any]
    effects: tuple[str, ...]


def run(body: RigidBody, samples: Samples, effects: tuple[str, ...]) -> Outcome:
    """Diagnose samples with the effects declared so far, given as text; raises SemiparamError as the command does."""
    from semiparam_ros.diagnosis.diagnose import diagnose
    from semiparam_ros.diagnosis.words import in_words
    from semiparam_ros.effects import effect_from_text

    found = diagnose(body, samples, [effect_from_text(text) for text in effects])
    return Outcome(found.verdict, in_words(found), found.as_dict(), declared(found))


def declared(found: Diagnosis) -> tuple[str, ...]:
    """The effects of the final model, starts as stamps: a node counts time from its own start, which a reset moves."""
    from semiparam_ros.effects import effect_to_text

    origin = found.recorded.samples.origin
    return tuple(effect_to_text(effect.at_stamp(origin)) for effect in found.final.effects)


def thinned(samples: Samples) -> Samples:
    """Evenly fewer of them, where a fast sensor gave more than a diagnosis can look at in half a minute."""
    step = -(-len(samples) // SAMPLES_AT_MOST)
    return samples[np.arange(0, len(samples), step)] if step > 1 else samples
