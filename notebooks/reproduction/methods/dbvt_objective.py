r"""The paper's objective: five losses of one pixel's smooth signal, noise and emissivities.

Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334, algorithm 1, with three slips put right:
the reconstruction starts from the second band's smooth signal (printed: the first's), the mean of
the noise enters by its square (printed: signed, without a lower bound), and a signal is divided by
no less than its noise. Signals are linearised, so that both slopes a_m are 1. Sums over time are
means, so that no weight depends on the number of frames.

With the emission and the reflection ratio :math:`k_1 = e_2 / e_1, k_2 = (1-e_2) / (1-e_1)`:

.. math:: \tilde I_2(t) = \tilde I_2(t-1) + k_1 [\tilde I_1(t) - \tilde I_1(t-1)]
          = \tilde I_2(0) + k_1 [\tilde I_1(t) - \tilde I_1(0)] \qquad (1)

.. math:: \ddot I_m = I_m - n_m, \quad p_m = \ddot I_m - \tilde I_m, \quad
          \hat I_2 = \tilde I_2 + k_2 (\ddot I_1 - \tilde I_1), \quad
          r = \ddot I_2 - \hat I_2 = p_2 - k_2 p_1 \qquad (2)

**Newton's steps**, damped, in all unknowns of a pixel at once: the objective is convex in
everything but the two emissivities, and its second derivatives have a shape that is solved in a
time proportional to the number of frames: a 2x2 block of noise for each frame, a band of width five
for the smooth signal (Whittaker's smoother), a border of three columns for its second offset and
the two ratios. A step solves for all of them.

Beyond its threshold the Huber loss has no curvature: a share of that of a parabola above it (Huber
1981, doi:10.1002/0471725250) is added, as much as it takes to lower the objective.

All is compiled, a pixel at a time. Its unknowns are `films`, the smooth signal of the first band
and the noise of both (3, time) [K], and `scalars`: the first value of the second band's smooth
signal [K] and both emissivities [1].
"""

from typing import Final, NamedTuple

import numpy as np

from dbthermal._arrays import Array
from dbthermal._compiled import compiled

# Weight of the noise where it is not modelled.
_NO_NOISE: Final = 1e8
# Damping of the emissivities, per frame: first, range, and its factors after a step that lowers the
# objective and one that does not. The same for the share of the parabola's curvature.
_FIRST_DAMPING, _DAMPING, _EASIER, _HARDER = 1e-2, (1e-6, 1e12), 0.1, 10.0
_SHARE, _LESS, _MORE = (1e-4, 1.0), 0.3, 4.0


class Weights(NamedTuple):
    """Fields of `DbvtSettings` as numbers, but for the curvature of a frame's interval."""

    smoothness: float
    huber: float
    reconstruction: float
    noise: float
    noise_mean: float
    huber_threshold: float
    tolerance: float
    largest_step: float
    margin: float
    curvature: float  # second difference that costs 1 [K]


class Scale(NamedTuple):
    """Scales of the objective, of the two bands."""

    sigma: tuple[float, ...]  # standard deviation of the noise [K]
    deviation: tuple[float, ...]  # by which the signals are normalised [K]
    share: float  # of the reconstruction's weight that counts [1]


@compiled
def _ratios(scalars: Array) -> tuple[float, float]:
    return scalars[2] / scalars[1], (1.0 - scalars[2]) / (1.0 - scalars[1])


@compiled
def deviation(signal: Array, noise: Array, sigma: float, floor: float) -> float:
    """Standard deviation over time [K] of the corrected signal of a band, at least the noise."""
    mean, square = (signal - noise).mean(), 0.0
    for t in range(signal.size):
        square += (signal[t] - noise[t] - mean) ** 2
    return float(max(np.sqrt(square / (signal.size - 1)), floor * sigma))


@compiled
def departures(films: Array, scalars: Array, signals: Array, t: int) -> tuple[float, float, float]:
    """Departures p_m from the smooth signals, and error r of the reconstruction, in a frame [K]."""
    emission, reflection = _ratios(scalars)
    first = signals[0, t] - films[1, t] - films[0, t]
    second = signals[1, t] - films[2, t] - scalars[0] - emission * (films[0, t] - films[0, 0])
    return first, second, second - reflection * first


@compiled
def huber(value: float, threshold: float) -> float:
    """Huber's loss (1964), doi:10.1214/aoms/1177703732, over its threshold."""
    size = abs(value)
    return value**2 / (2.0 * threshold) if size <= threshold else size - threshold / 2.0


@compiled
def losses(films: Array, scalars: Array, signals: Array, scale: Scale, weights: Weights) -> Array:
    """Weighted losses (5,) [1] in the order of the weights; their sum is the objective."""
    emission, _ = _ratios(scalars)
    sums, mean, frames = np.zeros(5), np.zeros(2), films.shape[1]
    sigma, deviation = scale.sigma, scale.deviation
    limit = (
        weights.huber_threshold * sigma[0] / deviation[0],
        weights.huber_threshold * sigma[1] / deviation[1],
    )
    for t in range(frames):
        first, second, error = departures(films, scalars, signals, t)
        if t > 1:
            sums[0] += (films[0, t] - 2.0 * films[0, t - 1] + films[0, t - 2]) ** 2
        sums[1] += huber(first / deviation[0], limit[0]) + huber(second / deviation[1], limit[1])
        sums[2] += error**2
        sums[3] += (films[1, t] / sigma[0]) ** 2 + (films[2, t] / sigma[1]) ** 2
        for band in (0, 1):
            mean[band] += films[1 + band, t] / sigma[band]
    # gamma_1 (1 + k_1^2) mean (I1~'' / curvature)^2, for the second smooth signal bends k_1 times.
    sums[0] *= weights.smoothness * (1.0 + emission**2) / weights.curvature**2
    # gamma_2 mean H(p_m / deviation_m), gamma_3 mean (r / sigma_2)^2
    sums[1] *= weights.huber
    sums[2] *= weights.reconstruction * scale.share / sigma[1] ** 2
    # gamma_4 mean (n_m / sigma_m)^2 and gamma_5 (mean n_m / sigma_m)^2
    sums[3] *= weights.noise
    sums[4] = weights.noise_mean * (mean**2).sum() / frames
    sums /= frames
    return sums


@compiled
def _noise_weights(scale: Scale, weights: Weights) -> tuple[Array, Array]:
    """Curvatures (band) of the noise's square and of its mean's, which by Jensen is a majorant."""
    variance = np.array(scale.sigma) ** 2
    single = weights.noise if weights.noise > 0 else _NO_NOISE
    return single / variance, weights.noise_mean / variance


@compiled
def _huber_force(
    departure: float, scale: Scale, weights: Weights, band: int, share: float
) -> tuple[float, float]:
    """Curvature of a band, beyond the threshold a share of a parabola's, and gradient."""
    threshold, size = weights.huber_threshold * scale.sigma[band], abs(departure)
    parabola = 0.5 * weights.huber / scale.deviation[band] / max(size, threshold)
    return (parabola if size <= threshold else share * parabola), parabola * departure


@compiled
def _block(a: float, c: float, weight: float, reflection: float) -> tuple[float, ...]:
    """Block N of a frame's noise: diag(q + h), its diagonal, and its inverse determinant."""
    # det N = a c + w (a + k_2^2 c)
    inverse = 1.0 / (a * c + weight * (a + reflection**2 * c))
    return a, c, a + weight * reflection**2, c + weight, inverse


@compiled
def system(
    films: Array, scalars: Array, signals: Array, scale: Scale, weights: Weights, share: float
) -> tuple[Array, Array, Array]:
    r"""Newton's equations of each frame, the noise eliminated, in the changes of three forms.

    .. math:: x = d\tilde I_1, \quad y = d\tilde I_2, \quad z = p_1\, dk_2

    With the curvatures q of the noise, h of the Huber losses and w of the reconstruction, the
    noise has the block :math:`N = diag(q + h) + w v v^T, v = (k_2, -1)`. Curvatures and forces
    (negative gradients) are half the derivatives of the objective, times the number of frames.
    Returns the quadratic form (time, 6): of the smooth signal, x = ds and y = k_1 ds, the same with
    y and with z, then yy, yz, zz; the forces (time, 3) of the smooth signal, y and z; and for
    `noise_step` (time, 5) pull and q + h of both bands, and p_1.
    """
    (k1, k2), frames = _ratios(scalars), films.shape[1]
    form, forces, blocks = np.empty((frames, 6)), np.empty((frames, 3)), np.empty((frames, 5))
    w = weights.reconstruction * scale.share / scale.sigma[1] ** 2
    square, mean = _noise_weights(scale, weights)
    q, level1, level2 = square + mean, mean[0] * films[1].mean(), mean[1] * films[2].mean()
    for t in range(frames):
        first, second, error = departures(films, scalars, signals, t)
        error *= w
        own1, own2 = square[0] * films[1, t] + level1, square[1] * films[2, t] + level2
        h1, pull1 = _huber_force(first, scale, weights, 0, share)
        h2, pull2 = _huber_force(second, scale, weights, 1, share)
        pull1, pull2 = own1 - pull1 + k2 * error, own2 - pull2 - error
        a, c, n11, n22, inverse = _block(q[0] + h1, q[1] + h2, w, k2)
        # What is left of the quadratic form: with K = N - diag(q), diag(q) N^-1 K in x and y,
        # written so that nothing cancels where both ratios are alike.
        coupling = w * q[0] * q[1] * (k1 - k2)
        diagonal = q[0] * h1 * n22 + k1**2 * q[1] * h2 * n11
        shared = w * (k2**2 * q[0] * h2 + k1**2 * q[1] * h1)
        form[t, 0] = (diagonal + shared + coupling * (k1 - k2)) * inverse
        form[t, 1] = (k1 * q[1] * (h2 * n11 + w * h1) + coupling) * inverse
        form[t, 2] = (w * (k1 * q[1] * h1 - k2 * q[0] * h2) + coupling) * inverse
        form[t, 3] = q[1] * (h2 * n11 + w * a) * inverse
        form[t, 4], form[t, 5] = q[1] * a * w * inverse, a * c * w * inverse
        n1 = (n22 * pull1 + w * k2 * pull2) * inverse
        n2 = (w * k2 * pull1 + n11 * pull2) * inverse
        force_y = own2 - q[1] * n2
        forces[t, 0], forces[t, 1] = own1 - q[0] * n1 + k1 * force_y, force_y
        forces[t, 2] = error - w * (k2 * n1 - n2)
        blocks[t, 0], blocks[t, 1], blocks[t, 4] = pull1, pull2, first
        blocks[t, 2], blocks[t, 3] = q[0] + h1, q[1] + h2
    return form, forces, blocks


@compiled
def noise_step(
    blocks: Array, moves: Array, scalars: Array, scale: Scale, weights: Weights
) -> Array:
    """Steps of smooth signal and noise (3, time), of the forms x, y and z (3, time)."""
    square, mean = _noise_weights(scale, weights)
    (_, k2), q, step = _ratios(scalars), square + mean, moves.copy()
    w = weights.reconstruction * scale.share / scale.sigma[1] ** 2
    for t in range(len(blocks)):
        _, _, n11, n22, inverse = _block(blocks[t, 2], blocks[t, 3], w, k2)
        x, y, error = moves[0, t], moves[1, t], w * moves[2, t]
        first, second = q[0] * x + k2 * error - blocks[t, 0], q[1] * y - error - blocks[t, 1]
        step[1, t] = (n22 * first + w * k2 * second) * inverse - x
        step[2, t] = (w * k2 * first + n11 * second) * inverse - y
    return step


@compiled
def bending(signal: Array) -> tuple[Array, float]:
    r""":math:`D^T D x` (time,) and :math:`|D x|^2`, D the second differences."""
    result, square = np.zeros(signal.size), 0.0
    for t in range(signal.size - 2):
        second = signal[t] - 2.0 * signal[t + 1] + signal[t + 2]
        result[t] += second
        result[t + 1] -= 2.0 * second
        result[t + 2] += second
        square += second**2
    return result, square


@compiled
def whittaker(diagonal: Array, stiffness: float, sides: Array) -> Array:
    r"""Solutions (time, side) of Whittaker's smoother for several right sides.

    .. math:: (\mathrm{diag}(d) + \lambda D^T D)\, x = b

    with d (time,) positive, :math:`\lambda`, b (time, side) of at least four times (Whittaker 1923,
    doi:10.1017/S0013091500077853): of bandwidth five, positive definite, solved by the factors
    :math:`L\,\mathrm{diag}(p)\,L^T` with a recursion over time. Two rows of zeros before and behind
    take what the ends have not; so do pivots of infinity.
    """
    rows = diagonal.size + 4
    solved, pivot = np.zeros((rows, sides.shape[1])), np.full(rows, np.inf)
    below, further = np.zeros(rows), np.zeros(rows)
    for t in range(2, rows - 2):  # forward: the factors
        # D^T D has the diagonal 1, 5, 6, ..., 6, 5, 1, beside it -2, -4, ..., -4, -2, and then 1.
        center = (1.0, 5.0, 6.0)[min(t - 2, rows - 3 - t, 2)]
        neighbour = -2.0 if t in (3, rows - 3) else -4.0
        near = stiffness * (neighbour - below[t - 1])
        below[t], further[t] = near / pivot[t - 1], stiffness / pivot[t - 2]
        pivot[t] = diagonal[t - 2] + center * stiffness - below[t] * near - further[t] * stiffness
        for side in range(sides.shape[1]):
            before = below[t] * solved[t - 1, side] + further[t] * solved[t - 2, side]
            solved[t, side] = sides[t - 2, side] - before
    for t in range(rows - 3, 1, -1):  # and backward
        for side in range(sides.shape[1]):
            after = below[t + 1] * solved[t + 1, side] + further[t + 2] * solved[t + 2, side]
            solved[t, side] = solved[t, side] / pivot[t] - after
    return solved[2:-2]


@compiled
def _emissivity(
    scalars: Array, border: Array, forces: Array, damping: float, weights: Weights
) -> tuple[float, float]:
    """New emissivities: damped, of limited change, inside (0, 1)."""
    # The offset is eliminated: a symmetric system A da = f in the two ratios.
    pull = border[0, 1:] / border[0, 0]
    f1, f2 = forces[1] - pull[0] * forces[0], forces[2] - pull[1] * forces[0]
    a11 = border[1, 1] - pull[0] * border[0, 1]
    a12 = border[1, 2] - pull[0] * border[0, 2]
    a22 = border[2, 2] - pull[1] * border[0, 2]
    # With J = d(k_1, k_2) / d(e_1, e_2): (J^T A J + damping) de = J^T f
    _, e1, e2 = scalars
    j11, j12 = -e2 / e1**2, 1.0 / e1
    j21, j22 = (1.0 - e2) / (1.0 - e1) ** 2, -1.0 / (1.0 - e1)
    a = a11 * j11**2 + 2.0 * a12 * j11 * j21 + a22 * j21**2 + damping
    b = a11 * j11 * j12 + a12 * (j11 * j22 + j12 * j21) + a22 * j21 * j22
    c = a11 * j12**2 + 2.0 * a12 * j12 * j22 + a22 * j22**2 + damping
    push1, push2 = j11 * f1 + j21 * f2, j12 * f1 + j22 * f2
    determinant = a * c - b * b
    step1, step2 = (c * push1 - b * push2) / determinant, (a * push2 - b * push1) / determinant
    share = min(weights.largest_step / max(abs(step1), abs(step2)), 1.0)
    low, high = weights.margin, 1.0 - weights.margin
    return min(max(e1 + share * step1, low), high), min(max(e2 + share * step2, low), high)


@compiled
def _propose(
    films: Array,
    scalars: Array,
    signals: Array,
    scale: Scale,
    weights: Weights,
    damping: float,
    share: float,
) -> tuple[Array, Array]:
    """Unknowns after a Newton step: noise, then smooth signal, then border are eliminated."""
    form, forces, blocks = system(films, scalars, signals, scale, weights, share)
    frames, (k1, k2) = films.shape[1], _ratios(scalars)
    # The smoothness loss is stiff (1 + k_1^2) |D s|^2 / 2, in the smooth signal s and in k_1.
    stiff = weights.smoothness / weights.curvature**2
    bend, square = bending(films[0])
    # y = k_1 ds + dO + s dk_1, z = p_1 dk_2: the forms of the border (offset, k_1, k_2)
    sides = np.empty((frames, 4))
    for t in range(frames):
        sides[t, 0] = forces[t, 0] - stiff * (1.0 + k1**2) * bend[t]
        sides[t, 1] = form[t, 1]
        sides[t, 2] = films[0, t] * form[t, 1] + stiff * k1 * bend[t]
        sides[t, 3] = blocks[t, 4] * form[t, 2]
    # (diag(h) + lambda D^T D) [s, S] = [force, sides]
    solved = whittaker(form[:, 0], stiff * (1.0 + k1**2), sides)
    # Schur complement of the border: B - sides^T S, f - sides^T s
    border, push = np.zeros((3, 3)), np.zeros(3)
    for t in range(frames):
        s, p, yy, yz = films[0, t], blocks[t, 4], form[t, 3], form[t, 4]
        push[0] += forces[t, 1]
        push[1] += s * forces[t, 1]
        push[2] += p * forces[t, 2]
        border[0, 0] += yy
        border[0, 1] += s * yy
        border[0, 2] += p * yz
        border[1, 1] += s**2 * yy
        border[1, 2] += s * p * yz
        border[2, 2] += p**2 * form[t, 5]
        for i in range(3):
            push[i] -= sides[t, i + 1] * solved[t, 0]
            for j in range(i, 3):
                border[i, j] -= sides[t, i + 1] * solved[t, j + 1]
    push[1] -= stiff * k1 * square
    border[1, 1] += stiff * square
    e1, e2 = _emissivity(scalars, border, push, damping * frames, weights)
    new = np.array([scalars[0], e1, e2])
    # Back substitution: the ratios as they became, then the offset, the smooth signal, the noise.
    after1, after2 = _ratios(new)
    move1, move2 = after1 - k1, after2 - k2
    offset = (push[0] - border[0, 1] * move1 - border[0, 2] * move2) / border[0, 0]
    step = np.empty_like(films)
    for t in range(frames):
        step[0, t] = solved[t, 0] - solved[t, 1] * offset
        step[0, t] -= solved[t, 2] * move1 + solved[t, 3] * move2
        step[1, t] = k1 * step[0, t] + offset + films[0, t] * move1
        step[2, t] = blocks[t, 4] * move2
    # The border's offset is that of the line between the smooth signals: back to the first frame.
    new[0] += offset - k1 * films[0, 0] + after1 * (films[0, 0] + step[0, 0])
    return films + noise_step(blocks, step, scalars, scale, weights), new


@compiled
def descend(
    films: Array,
    scalars: Array,
    signals: Array,
    scale: Scale,
    weights: Weights,
    steps: int,
    patience: int,
) -> tuple[Array, Array, float, bool]:
    """Unknowns and objective of a pixel after Newton's steps; true if it stopped improving."""
    damping, share, stalled = _FIRST_DAMPING, _SHARE[1], 0
    loss = losses(films, scalars, signals, scale, weights).sum()
    for _ in range(steps):
        new, ratios = _propose(films, scalars, signals, scale, weights, damping, share)
        proposed = losses(new, ratios, signals, scale, weights).sum()
        before, better = loss, proposed <= loss  # false where it is NaN
        if better:
            films, scalars, loss = new, ratios, proposed
        stalled = stalled + 1 if before - loss <= weights.tolerance * before else 0
        damping = min(max(damping * (_EASIER if better else _HARDER), _DAMPING[0]), _DAMPING[1])
        share = min(max(share * (_LESS if better else _MORE), _SHARE[0]), _SHARE[1])
        if stalled >= patience:
            break
    return films, scalars, loss, stalled >= patience and np.isfinite(loss)
