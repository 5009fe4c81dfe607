"""Tests of what is refused, from a table of arguments and the messages of their errors."""

import re
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ParamSpec

import pytest

Arguments = ParamSpec("Arguments")
Errors = type[BaseException] | tuple[type[BaseException], ...]
REFUSALS = (KeyError, TypeError, ValueError)


def raising(message: str | None) -> AbstractContextManager[object]:
    """Context in which a ValueError with a message is raised, or nothing where there is none."""
    return pytest.raises(ValueError, match=message) if message else nullcontext()


def assert_raises(
    error: Errors,
    message: str,
    call: Callable[Arguments, object],
    /,
    *arguments: Arguments.args,
    **options: Arguments.kwargs,
) -> None:
    """A call raises an error, of which a pattern is found in the message."""
    with pytest.raises(error, match=message):
        call(*arguments, **options)


def assert_refused(
    message: str,
    call: Callable[Arguments, object],
    /,
    *arguments: Arguments.args,
    **options: Arguments.kwargs,
) -> None:
    """A call raises a ValueError, of which a pattern is found in the message."""
    assert_raises(ValueError, message, call, *arguments, **options)


def refused(
    call: Callable[..., Any],
    rows: Iterable[Sequence[Any]],
    fixtures: str = "",
    error: Errors = REFUSALS,
) -> Any:
    """Test of a function that raises an error for the arguments of each row.

    The last entry of a row is a part of the error's message, or a pattern of it. The function takes
    the values of the fixtures, by name, and then the arguments.
    """

    @pytest.mark.parametrize("row", [*rows], ids=lambda row: str(row[-1]))
    def test(row: Sequence[Any], request: pytest.FixtureRequest) -> None:
        *arguments, message = row
        values = [request.getfixturevalue(name) for name in fixtures.split()]
        with pytest.raises(error) as caught:
            call(*values, *arguments)
        text = str(caught.value)
        assert message in text or re.search(message, text), text

    return test
