"""Moving bodies around the twins: writing, hands and routes."""

import numpy as np

from reproduction.twins import surfaces
from reproduction.twins.panes import pointing
from reproduction.twins.people import FINGERS, Route, Writing, board, imprint, pacing
from reproduction.twins.stage import AMBIENT, clock
from reproduction.twins.surroundings import Pose


def test_writing_appears_and_fades() -> None:
    """A stroke is as cold as it was written, after it was written, and rewarms by 1/e."""
    writing = Writing("V", start=2.0, pace=0.1, drop=4.0, drying=10.0)
    times, path = writing.path()
    flat = surfaces.plate(0.2, 0.2, 0.002)
    places = np.asarray(flat.vertices)[:, [0, 2]] - (0.0, 0.1)
    actor = board(flat, places, writing, AMBIENT, lambda _: Pose())
    vertex = int(np.argmin(np.linalg.norm(places - path[-1], axis=1)))
    last = float(times[-1])
    warmth = [actor.warmth(now)[vertex] for now in (last - 1.0, last, last + 10.0)]
    np.testing.assert_allclose(warmth, [AMBIENT, AMBIENT - 4, AMBIENT - 4 / np.e], rtol=0, atol=0.1)


def test_the_index_writes_the_strokes() -> None:
    """The index's tip is a radius in front of each stroke, and nearer than other fingers."""
    writing, ends = Writing(start=3.0), np.array([(f.tip[0], 0.0, f.tip[1]) for f in FINGERS])
    for time, place in zip(*writing.path(), strict=True):
        tips = pointing(writing, float(time)).outwards(ends)
        expected = (-place[0], -FINGERS[1].radius, place[1])
        np.testing.assert_allclose(tips[1], expected, rtol=0, atol=1e-12)  # m
        others = [-tip[1] - part.radius for tip, part in zip(tips, FINGERS, strict=True)]
        assert min(others[:1] + others[2:]) > 0.002  # m


def test_pacing_keeps_its_pace() -> None:
    """Between the corners of the way the pace lies in its range, and pauses are pauses."""
    corners, rng = ((-2.0, 0.0), (0.0, 0.0), (2.0, 1.0)), np.random.default_rng(1)
    route = pacing(corners, clock(), rng, pace=(0.5, 1.0))
    lengths = np.linalg.norm(np.diff(route.places, axis=0), axis=1)
    speeds = lengths / np.diff(route.times)
    np.testing.assert_array_equal(speeds[::2], 0.0)
    assert np.all((speeds[1::2] > 0.5) & (speeds[1::2] < 1.0))
    assert route.times[-1] >= 34.9


def test_who_stands_faces_where_he_came_to() -> None:
    """A walk along y heads for y, and so does the pause after it."""
    route = Route(np.array([0.0, 1.0, 2.0, 3.0]), np.array([[0, 0], [0, 1], [0, 1], [1.0, 1]]))
    headings = [route.heading(time) for time in (-1.0, 0.5, 1.5, 2.5, 9.0)]
    np.testing.assert_allclose(headings, [np.pi / 2] * 3 + [0.0] * 2, rtol=0, atol=1e-12)


def test_a_hand_touches_under_palm_and_fingers() -> None:
    """The print is 1 at the palm and on a finger, 0 between the fingers and beyond."""
    share = imprint([(0.0, 0.0), (-0.010, 0.10), (-0.06, 0.06), (0.0, 0.2)])
    np.testing.assert_allclose(share, [1, 1, 0, 0], rtol=0, atol=1e-3)
