"""Byte dialogues that fail on leftovers."""

import pytest
from dialogue import Dialogue, Pair


@pytest.mark.parametrize(
    ("pairs", "steps", "message"),
    [
        ([(b"a", b"b")], ["a"], "Left unread"),
        ([(b"a", None)], [], "Left unwritten"),
        ([(b"ab", None)], ["a"], "Cut short"),
        ([(b"a", None)], ["b"], "Unexpected 62 was written. Must be 61"),
        ([], ["a"], "Must be nothing more"),
        ([(b"a", b"b"), (b"c", None)], ["a", "c"], "Unread .* but 63 was written"),
        ([(None, b"a")], [], "Left unread"),
    ],
)
def test_a_dialogue_allows_no_rest(pairs: list[Pair], steps: list[str], message: str) -> None:
    """Unread, unwritten and unexpected bytes fail the test."""

    def talk() -> None:
        with Dialogue(pairs) as line:
            for step in steps:
                line.write(step.encode())

    with pytest.raises(AssertionError, match=message):
        talk()


def test_a_dialogue_speaks_unasked_and_in_pieces() -> None:
    """Answers come in the pieces given, after writes in any pieces, and by themselves."""
    with Dialogue([(None, b"hi"), (b"ab", [b"c", b"de"]), (None, b"!")]) as line:
        assert line.read(9, 1.0) == b"hi"
        line.write(b"a")
        line.write(b"b")
        assert [line.read(1, 1.0) for _ in range(5)] == [b"c", b"d", b"e", b"!", b""]


def test_another_error_is_not_hidden_by_leftovers() -> None:
    """An error inside a dialogue is shown rather than what it left behind."""
    with pytest.raises(KeyError, match="first thing"), Dialogue([(b"a", None)]):
        raise KeyError("the first thing that went wrong")
