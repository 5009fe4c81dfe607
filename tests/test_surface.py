"""What a user meets: completion shows what is public, and its documentation reads plainly."""

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import pytest

import dbthermal

RIDDLE = re.compile(r"^(What|Whether|How|That|Where|Which|None|Those)\b|\bthat there is not\b")


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
    found = {}
    for module in MODULES.values():
        for name in module.__all__:
            value = getattr(module, name)
            if inspect.isfunction(value) or inspect.isclass(value):
                found[f"{value.__module__}.{value.__qualname__}"] = value
    return found


def test_the_package_lists_its_modules() -> None:
    """`dbthermal.<TAB>` shows every public module."""
    modules = {module.name for module in pkgutil.iter_modules(dbthermal.__path__)}
    assert {name for name in modules if not name.startswith("_")} == set(dbthermal.__all__)


@pytest.mark.parametrize("name", MODULES)
def test_completion_shows_what_is_public(name: str) -> None:
    """`dir()` of a public module is its `__all__`, sorted, and each name is there."""
    module = MODULES[name]
    assert dir(module) == sorted(module.__all__)
    assert all(hasattr(module, public) for public in module.__all__)


@pytest.mark.parametrize("name", public_functions())
def test_summary_is_one_plain_sentence(name: str) -> None:
    """A public docstring begins with one sentence in the field's words."""
    summary = (inspect.getdoc(public_functions()[name]) or "").partition("\n\n")[0]
    assert summary.endswith(".")
    assert not RIDDLE.search(summary), summary


@pytest.mark.parametrize("name", public_functions())
def test_options_are_explicit(name: str) -> None:
    """No public function hides its options behind `**options`."""
    value = public_functions()[name]
    if inspect.isfunction(value):
        kinds = {parameter.kind for parameter in inspect.signature(value).parameters.values()}
        assert inspect.Parameter.VAR_KEYWORD not in kinds
