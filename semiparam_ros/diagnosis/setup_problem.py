"""What a check of the set-up says: one sentence, with the remedy."""

from __future__ import annotations

from typing import NamedTuple


class SetupProblem(NamedTuple):
    """Something that is wrong before any physics: a unit, a sign, an order.

    ``what`` is a word for programs (``joint_order``), ``where`` the joint or frame concerned, ``sentence`` what a user
    reads.
    """

    what: str
    where: str | None
    sentence: str
