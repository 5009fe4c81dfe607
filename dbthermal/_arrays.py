"""Types of arrays that most modules share: real numbers in double precision, and masks."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
