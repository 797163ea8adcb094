"""An effect that is in some of several recordings alone: a load in the second and not in the first."""

from __future__ import annotations

from dataclasses import replace

from semiparam_ros.core.types import Array
from semiparam_ros.diagnosis.data.recordings import spans
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.effects import Effect


def in_some_recordings(fit: Fit, effect: Effect, started: Array, always: Array) -> tuple[Effect, Array]:
    """The effect and its columns in those recordings in a row where it explains most, if that is plainer or better.

    :param started: (N, n, c) its columns with the start that was found, :param always: without one.
    """
    if not fit.samples.breaks or effect.is_calibration or effect.of_one_recording:
        return effect, started
    found = (effect, started)
    best = _explained(fit, effect, started)
    least = best * (1.0 - fit.config.whole_recording_share) if effect.span.values \
        else best * fit.config.some_recordings_ratio
    for span in spans(fit.samples):
        columns = always * span.holds(fit.samples.stamps, fit.samples.origin)[:, None, None]
        explained = _explained(fit, effect, columns)
        if explained > least:
            least, found = explained, (replace(effect, span=span), columns)
    return found


def _explained(fit: Fit, effect: Effect, columns: Array) -> float:
    """Squares that the columns explain, in scaled units; none with coefficients that the cause cannot have.

    A load in all recordings but the first explains what one of negative mass in the first does.
    """
    left, coefficients = fit.loss_with(columns)
    return fit.loss - left if effect.physical(coefficients) else 0.0
