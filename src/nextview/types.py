"""Array types that the whole package shares."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Floats = NDArray[np.floating]  # of any precision
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
