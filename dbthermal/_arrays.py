"""Types of arrays that most modules share, and what lets one text compute on arrays and tensors.

An array is one of NumPy; where a function asks for its `namespace`, a tensor of torch will do, on
any device. Only names that both have, with the same meaning, are then used.
"""

import sys
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


def namespace(values: Any) -> Any:
    """NumPy, or torch for a tensor: the module whose functions take the values."""
    return sys.modules["torch"] if type(values).__module__ == "torch" else np


def real(values: Any) -> Any:
    """Values in double precision; a tensor as it is."""
    return np.asarray(values, dtype=np.float64) if namespace(values) is np else values


def like(values: npt.ArrayLike, other: Any) -> Any:
    """Values as an array, or as a tensor on the device of another."""
    return namespace(other).asarray(np.array(values), device=other.device)


def host(values: Any) -> npt.NDArray[Any]:
    """Array of values that may be on a device."""
    return np.asarray(values if namespace(values) is np else values.cpu())


def quotient(numerator: Any, denominator: Any, otherwise: float) -> Any:
    """Quotient where the denominator is positive, and another value elsewhere."""
    xp, positive = namespace(denominator), denominator > 0
    return xp.where(positive, numerator / xp.where(positive, denominator, 1.0), otherwise)


def select(values: Any, selected: Any, axis: int = -1) -> Any:
    """Values at the selected places along an axis, told by a mask or by their numbers.

    Along the last one, an index of NumPy would leave the axes in another order in memory, and take
    several times as long.
    """
    if namespace(values) is not np:
        return values.movedim(axis, -1)[..., selected].movedim(-1, axis)
    selected = np.flatnonzero(selected) if selected.dtype == bool else selected
    return values.take(selected, axis=axis)
