"""Array types of the simulator, which shares no code with the package's models."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Stamps: TypeAlias = NDArray[np.int64]
