"""Effects that only imitate a cause of no listed kind: a function that knows nothing of robots explains more than they.

A cause of no listed kind resembles several listed ones a little, and a search adds one after the other. What they all
leave is compared with what the most general alternative leaves: a smooth function of the motion and of time, fitted to
other blocks of the recording. The laws of causes that are there hold on unseen blocks, and leave less than that.
"""

from __future__ import annotations

from semiparam_ros.diagnosis.data.splits import block_sums
from semiparam_ros.diagnosis.regression import Fit
from semiparam_ros.diagnosis.residual.flexible import StandardisedInputs, explained
from semiparam_ros.diagnosis.residual.structure import samples_to_look_at
from semiparam_ros.diagnosis.search.score import summed


def function_explains_more(first: Fit, final: Fit) -> bool:
    """Whether a function of the motion and of time beside the first model predicts unseen blocks better than the final
    model does."""
    config = final.config
    rows = samples_to_look_at(final.train_mask, config)
    if final is first or len(rows) < config.structure_least_samples:
        return False
    missing, left = ((fit.residual * fit.counted)[rows] / final.scale for fit in (first, final))
    found, _ = explained(StandardisedInputs(final.body.joints, final.samples[rows], config), missing)
    gains = summed(block_sums(left**2 - (missing - found)**2, config.blocks).sum(axis=1))
    return gains.total > gains.error
