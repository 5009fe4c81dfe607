"""The smooth subspace of time: what a slowly changing object temperature can do.

An orthonormal basis of polynomials over the capture's own time stamps. The bases are nested, so
the fit of every order follows from one set of coefficients.
"""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def basis(time: npt.ArrayLike, order: int) -> Array:
    r"""
    Orthonormal polynomials over given times, the discrete Legendre polynomials.

    Parameters
    ----------
    time : array_like, shape (time,)
        Times [s], strictly increasing, not necessarily evenly spaced.
    order : int
        Number of functions, the constant included.

    Returns
    -------
    ndarray, shape (time, order)
        Column j is a polynomial of degree j; :math:`\Phi^T \Phi = 1`.

    Raises
    ------
    ValueError
        If the order is not in [1, number of times].
    """
    time = np.asarray(time, dtype=np.float64)
    if not 1 <= order <= time.size:
        raise ValueError(
            f"Invalid order {order} of the smooth subspace. Must lie in [1, {time.size}], "
            "the number of frames."
        )
    span = time[-1] - time[0] if time.size > 1 else 1.0
    position = 2.0 * (time - time[0]) / span - 1.0
    columns, _ = np.linalg.qr(np.polynomial.legendre.legvander(position, order - 1))
    return np.asarray(columns)


def leverage(functions: Array) -> Array:
    r"""
    Variance factor of a fit at each time, for every order at once.

    Parameters
    ----------
    functions : ndarray, shape (time, order)
        From `basis`.

    Returns
    -------
    ndarray, shape (time, order)
        Column j holds :math:`\sum_{i \le j} \Phi_i(t)^2`: the variance of a fit of order j + 1
        to white noise of variance 1.
    """
    return np.asarray(np.cumsum(functions**2, axis=1))


def residual_energy(functions: Array, first: Array, second: Array) -> Array:
    r"""
    Inner product of two signals after projection, for every order at once.

    .. math:: S_K = \sum_t a b - \sum_{j \le K} (\Phi_j^T a)(\Phi_j^T b)

    Parameters
    ----------
    functions : ndarray, shape (time, order)
        From `basis`.
    first, second : ndarray, shape (time, pixel)
        Signals.

    Returns
    -------
    ndarray, shape (order, pixel)
        Row j is the inner product orthogonal to the first j + 1 functions.
    """
    total = np.einsum("tp,tp->p", first, second)
    return np.asarray(total - np.cumsum((functions.T @ first) * (functions.T @ second), axis=0))
