"""The methods by name; each is a module, imported when it is first used."""

import importlib
from dataclasses import fields
from typing import Any, Final

from dbthermal.separation._problem import Method

_MODULES: Final = {
    "subspace": "_subspace.method",
    "calibrated": "_baselines.calibrated",
    "dbvt": "_dbvt.method",
    "naive": "_baselines.naive",
    "ratio": "_baselines.ratio",
    "bcp": "_baselines.bcp",
    "apparent": "_baselines.apparent",
}
METHODS: Final = tuple(_MODULES)
"""Names of the methods."""


def get(name: str) -> Method:
    """
    Return a method's record.

    Parameters
    ----------
    name : str
        One of `METHODS`.

    Returns
    -------
    Method
        What the module of that name hands to `solve`.

    Raises
    ------
    ValueError
        If there is no such method.
    """
    if name not in METHODS:
        raise ValueError(f"Unknown method '{name}'. Must be one of {list(METHODS)}.")
    found: Method = importlib.import_module(f"dbthermal.separation.{_MODULES[name]}").METHOD
    return found


def settings(name: str, options: dict[str, Any]) -> Any:
    """
    Return a method's settings.

    Parameters
    ----------
    name : str
        One of `METHODS`.
    options : dict
        Fields of its settings, by name; the others have their defaults.

    Returns
    -------
    object
        Its frozen record, None for a method without any.

    Raises
    ------
    TypeError
        If it has no such option, or one that is a number of things is not whole.
    ValueError
        If a value is not allowed, see the method's `Settings`.
    """
    kind = get(name).settings
    names = [] if kind is None else [field.name for field in fields(kind)]
    unknown = sorted(options.keys() - set(names))
    if unknown:
        raise TypeError(f"Unknown option '{unknown[0]}' of method '{name}'. Has {names}.")
    for field in () if kind is None else fields(kind):
        value = options.get(field.name, field.default)
        if type(field.default) is int and type(value) is not int:
            raise TypeError(
                f"Invalid {field.name} {value!r} of method '{name}'. Must be a whole number."
            )
    return None if kind is None else kind(**options)
