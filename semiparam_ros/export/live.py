"""Physically consistent parameters of a running node: the bodies that an export would write."""

from __future__ import annotations

import json
import time
from typing import NamedTuple

from semiparam_ros.core.types import Array
from semiparam_ros.export.estimate import Estimate
from semiparam_ros.export.identified import identified_load, identify
from semiparam_ros.export.report import document
from semiparam_ros.export.urdf import described_links


class ConsistentParameters(NamedTuple):
    """Parameters of bodies that can be.

    :param document: what the JSON file of an export holds. :param theta: (p,) all coefficients.
    :param load: (10,) inertial parameters of what is carried; None where none was asked for.
    :param seconds: processor time that it took.
    """

    document: str
    theta: Array
    load: Array | None
    seconds: float


def consistent_parameters(urdf: str, estimate: Estimate,
                          load: tuple[Array, Array] | None) -> ConsistentParameters:
    """Parameters as near to an estimate as bodies can be.

    :param load: inertial parameters (10,) of what is carried, and their covariance (10, 10).

    Raises SemiparamError when no link that the outputs feel has a mass, or the estimate is not
    finite.
    """
    begun = time.process_time()
    found = identify(estimate, described_links(urdf))
    body = None if load is None else identified_load(estimate.columns.body, *load)
    return ConsistentParameters(json.dumps(document(found)), found.theta, body,
                                time.process_time() - begun)
