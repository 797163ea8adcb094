"""State of a few filters of every output, mixed by their evidence."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from semiparam_ros.core.types import Array
from semiparam_ros.errors import SemiparamError


class FilterBank:
    """K filters for each of n outputs, in one table (r, n): their values (K, n), their log weights
    (K, n), then what follows from both; the mixture (n,) stands last.

    :param name: to speak of it. :param share: probability of the first filter before anything is
        seen; the others share the rest.
    """

    def __init__(self, name: str, count: int, table: Array, share: float) -> None:
        self.table = table
        self._name, self._count = name, count
        shares = np.full((count, 1), (1.0 - share) / (count - 1))
        shares[0] = share
        self._log_weights[:] = np.log(shares)

    @property
    def _values(self) -> Array:
        return self.table[:self._count]

    @property
    def _log_weights(self) -> Array:
        return self.table[self._count:2 * self._count]

    @property
    def _mixture(self) -> Array:
        mixture: Array = self.table[-1]
        return mixture

    def state(self) -> dict[str, Array]:
        """A copy; :meth:`restore` takes it back bit for bit."""
        return {'table': self.table.copy()}

    def restore(self, state: Mapping[str, Array]) -> None:
        """Return to a saved :meth:`state`. Raises SemiparamError, with nothing changed, when it
        cannot be one."""
        saved = np.array(state.get('table', np.zeros(0)), dtype=float)
        if saved.shape != self.table.shape or not self._possible(saved):
            raise SemiparamError(f'the saved values of {self._name} have shape {saved.shape}; expected finite ones of '
                                 f'shape {self.table.shape}, scales above zero.')
        self.table[:] = saved

    def _possible(self, table: Array) -> bool:
        return bool(np.isfinite(table).all())
