"""The public surface: completion shows what a user types, and each parameter is documented."""

import dataclasses
import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import pytest

import dbthermal


def public_modules(package: ModuleType = dbthermal) -> Iterator[ModuleType]:
    """Yield the modules that a user may import: not the private ones, nor the emulated devices."""
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        name = module.name.rpartition(".")[2]
        if name.startswith("_") or name == "emulated":
            continue
        loaded = importlib.import_module(module.name)
        yield loaded
        if module.ispkg:
            yield from public_modules(loaded)


MODULES = {module.__name__: module for module in (dbthermal, *public_modules())}


def public_functions() -> dict[str, Any]:
    """Functions and classes in `__all__` of the public modules, by their dotted names."""
    functions = {}
    for module in MODULES.values():
        for name in module.__all__:
            value = getattr(module, name)
            if inspect.isfunction(value) or inspect.isclass(value):
                functions[f"{value.__module__}.{value.__qualname__}"] = value
    return functions


def test_the_package_lists_its_modules() -> None:
    """`dbthermal.<TAB>` shows every public module."""
    modules = {module.name for module in pkgutil.iter_modules(dbthermal.__path__)}
    assert {name for name in modules if not name.startswith("_")} == {
        name for name in dbthermal.__all__ if inspect.ismodule(getattr(dbthermal, name))
    }


@pytest.mark.parametrize("name", MODULES)
def test_completion_shows_what_is_public(name: str) -> None:
    """`dir()` of a public module is its `__all__`, sorted, and each name is there."""
    module = MODULES[name]
    assert dir(module) == sorted(module.__all__)
    assert all(hasattr(module, public) for public in module.__all__)


SECTION = r"(?ms)^(?:Parameters|Attributes)\n-+\n(.*?)(?:\n\n[A-Z]\w+\n-|\Z)"
DRIVERS = re.compile(r"dbthermal\.instruments\.(?!protocols|recording|session)")


@pytest.mark.parametrize("name", [name for name in public_functions() if not DRIVERS.match(name)])
def test_parameters_have_a_section(name: str) -> None:
    """Parameters and fields are listed in their section; none hides behind `**options`."""
    value = public_functions()[name]
    if inspect.isfunction(value):
        kinds = {parameter.kind for parameter in inspect.signature(value).parameters.values()}
        assert inspect.Parameter.VAR_KEYWORD not in kinds
    record = dataclasses.is_dataclass(value)
    made_by = value if record else vars(value).get("__init__", value)
    names = inspect.get_annotations(made_by).keys() - {"return"}
    section = "\n".join(re.findall(SECTION, inspect.getdoc(value) or ""))
    lines = re.findall(r"(?m)^(\S.*?)(?: :|$)", section)
    listed = {entry.lstrip("*") for line in lines for entry in line.split(", ")}
    assert {each for each in names if not each.startswith("_")} <= listed
