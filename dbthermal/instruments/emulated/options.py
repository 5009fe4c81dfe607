"""Options in the address of an emulator, as in ``sim://boson?sn=7``: texts by their names."""

from collections.abc import Mapping, Sequence
from typing import TypeVar

Number = TypeVar("Number", bound=float)


def require_known(options: Mapping[str, str], names: Sequence[str]) -> None:
    """
    Refuse what an emulator does not understand.

    Parameters
    ----------
    options : mapping
        Text of each option by its name.
    names : sequence of str
        Those that it takes.

    Raises
    ------
    ValueError
        If there is another.
    """
    for name in sorted(options.keys() - {*names}):
        raise ValueError(f"Unknown option '{name}'. Must be one of {', '.join(names)}.")


def number(
    options: Mapping[str, str], name: str, default: Number, limits: tuple[Number, Number]
) -> Number:
    """
    Number that an option of an emulator's address gives, as in ``sim://boson?sn=7``.

    Parameters
    ----------
    options : mapping
        Text of each option by its name.
    name : str
        Of the option.
    default : int or float
        Without it; a whole number if only such ones are allowed.
    limits : tuple
        Least and largest number that is allowed.

    Returns
    -------
    int or float
        As `default` is.

    Raises
    ------
    ValueError
        If it is no such number.
    """
    if name not in options:
        return default
    lowest, highest = limits
    try:
        value = type(default)(options[name])
        allowed = lowest <= value <= highest  # which NaN is not
    except ValueError:
        allowed = False
    if not allowed:
        raise ValueError(
            f"Invalid option {name}={options[name]} of an emulator. "
            f"Must be a number ({type(default).__name__}) in {lowest} to {highest}."
        )
    return value
