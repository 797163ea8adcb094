"""Array types shared by every module."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Stamps: TypeAlias = NDArray[np.int64]
Indices: TypeAlias = NDArray[np.int64]
Codes: TypeAlias = NDArray[np.int8]
Mask: TypeAlias = NDArray[np.bool_]
