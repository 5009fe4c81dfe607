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


def get_method(name: str) -> Method:
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


def checked(name: str, settings: Any) -> Any:
    """
    Return the settings of a method, its defaults for None, and None for a method without any.

    Raises
    ------
    TypeError
        If they are another method's, or a field that is a number of things is not whole.
    """
    kind = get_method(name).settings
    if settings is None:
        return None if kind is None else kind()
    if kind is None or type(settings) is not kind:
        rule = "be omitted: it has no settings" if kind is None else f"be {kind.__name__}"
        raise TypeError(
            f"Invalid settings of type {type(settings).__name__} for method '{name}'. Must {rule}."
        )
    for field in fields(kind):
        value = getattr(settings, field.name)
        if type(field.default) is int and type(value) is not int:
            raise TypeError(
                f"Invalid {field.name} {value!r} of method '{name}'. Must be a whole number."
            )
    return settings
