"""Times of captures and motions, checked once for all that interpolate between them."""

import numpy as np
import numpy.typing as npt


def increasing(times: npt.ArrayLike, of: str) -> npt.NDArray[np.float64]:
    """
    Return times, two or more, that are finite and increase strictly.

    Parameters
    ----------
    times : array_like, shape (time,)
        Times [s].
    of : str
        What they are the times of, for the error.

    Returns
    -------
    ndarray, shape (time,)
        The same times.

    Raises
    ------
    ValueError
        If there are fewer than two, or one is not finite or not above the one before.
    """
    array = np.asarray(times, dtype=np.float64)
    if array.ndim != 1 or array.size < 2:
        raise ValueError(f"Invalid times of shape {array.shape} of {of}. Must be two or more.")
    # A NaN fails the comparison, too.
    wrong = np.flatnonzero(~np.isfinite(array) | ~(np.diff(array, prepend=-np.inf) > 0))
    if wrong.size:
        raise ValueError(
            f"Invalid time {array[wrong[0]]} s of {of}. Must be finite, and increase strictly."
        )
    return array
