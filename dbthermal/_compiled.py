"""Compiled functions, whose machine code is kept in files from process to process.

A file has a checksum, and the digest of the function and of all compiled functions and constants
that it uses, without comments, docstrings and line numbers. Damaged or old files are compiled
again; processes that need the same function wait for the first one to compile it.
"""

import hashlib
import logging
import os
import pickle
import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, Final
from uuid import uuid4

import numba
import numpy as np
from numba import njit
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

try:
    import fcntl
except ImportError:  # Windows: there each process compiles by itself
    fcntl = None  # type: ignore[assignment]

_LOGGER: Final = logging.getLogger(__name__)
_SIZE: Final = 32  # of a SHA-256 [byte]
_CONSTANTS: Final = (int, float, complex, str, bytes, slice, np.generic)
_USED: Final = (*_CONSTANTS, tuple, np.ndarray, Dispatcher)  # of a module, in machine code


def kept(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator that compiles a function at its first call, and keeps its machine code."""

    def decorate(function: Callable[..., Any]) -> Any:
        result: Any = njit(**(options | {"no_cfunc_wrapper": True}))(function)
        if hasattr(result, "py_func"):  # with NUMBA_DISABLE_JIT it is the function itself
            with suppress(RuntimeError):
                result._cache = cache = _Cache(result)
                result.compile = cache.in_turn(result.compile)
        return result

    return decorate


compiled: Final = kept(
    nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"}
)
"""Decorator of loops that take longer as passes over arrays; sums in any order, NaN stays NaN."""


class _Cache(FunctionCache):
    """Files of a compiled function, one for each kind of arguments and processor."""

    def __init__(self, function: Any) -> None:
        super().__init__(function.py_func)  # type: ignore[no-untyped-call]
        self._function = function
        self._locks = defaultdict[int, list[int]](list)  # numbers of locked files, by the thread

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Machine code for arguments, None if it is to be compiled, by this process alone."""
        target_context.refresh()
        path, digest = self._place(sig, target_context.codegen())
        if (data := _read(path, digest)) is None:
            self._lock(path)
            data = _read(path, digest)
        return None if data is None else self._impl.rebuild(target_context, data)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep machine code for arguments."""
        if not self._impl.check_cachable(data):
            return
        path, digest = self._place(sig, data.codegen)
        content = dumps(self._impl.reduce(data))  # type: ignore[no-untyped-call]
        draft = path.with_name(f".{path.name}.{uuid4().hex}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            draft.write_bytes(digest + hashlib.sha256(digest + content).digest() + content)
            draft.replace(path)
            _LOGGER.debug("Compiled code is kept as '%s'.", path)
        except OSError as error:
            _LOGGER.warning("Compiled code is not kept as '%s': %s.", path, error)
            with suppress(OSError):
                draft.unlink()

    def in_turn(self, compile_for: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """Compilation that frees the lock of its file at its end, however it ends."""

        def compile_in_turn(sig: Any) -> Any:
            files = self._locks[threading.get_ident()]
            held = len(files)
            try:
                return compile_for(sig)
            finally:
                while len(files) > held:
                    with suppress(OSError):  # explicitly: a forked process may have the file, too
                        fcntl.flock(files[-1], fcntl.LOCK_UN)
                    os.close(files.pop())

        return compile_in_turn

    def _lock(self, path: Path) -> None:
        """Wait until no other process compiles the same; without locks there is no waiting."""
        with suppress(OSError, AttributeError):
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = os.open(path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT, 0o666)
            self._locks[threading.get_ident()].append(lock)
            fcntl.flock(lock, fcntl.LOCK_EX)

    def _place(self, sig: Any, codegen: Any) -> tuple[Path, bytes]:
        """File for a kind of arguments, and the digest of the code and all else it depends on."""
        kinds = list(_kinds(sig if isinstance(sig, tuple) else sig.args))
        bare = ("OO",) if sys.flags.optimize > 1 else ()  # other instructions, in other files
        kind = hashlib.sha256(repr((kinds, codegen.magic_tuple(), *bare)).encode()).hexdigest()
        function = self._function.py_func
        name = f"{function.__module__}.{function.__qualname__}-{kind[:16]}"
        versions = f"{sys.implementation.cache_tag} {numba.__version__}"
        described = "\n".join([versions, kind, *_described(self._function, {})])
        path = Path(self.cache_path) / f"{name.replace('<', '').replace('>', '')}.nbc"
        return path, hashlib.sha256(described.encode()).digest()


def _read(path: Path, digest: bytes) -> Any:
    """Content of a file of compiled code; None if it is missing, damaged or of other code."""
    try:
        content = path.read_bytes()
        code, checksum, data = content[:_SIZE], content[_SIZE : 2 * _SIZE], content[2 * _SIZE :]
        if hashlib.sha256(code + data).digest() == checksum:
            return pickle.loads(data) if code == digest else None
    except FileNotFoundError:
        return None
    except Exception as error:  # noqa: BLE001 - whatever it holds, it can be made anew
        _LOGGER.warning("Unreadable compiled code: %s.", error)
    _LOGGER.warning("Damaged compiled code '%s'. It is compiled again.", path)
    return None


def _kinds(types: Any) -> Iterator[str]:
    """Types of arguments, with the names of fields, by which compiled code finds their places."""
    for kind in types:
        yield f"{kind} {getattr(kind, 'fields', '')}"
        yield from _kinds(getattr(kind, "types", ()))


def _described(value: Any, visited: dict[int, int]) -> Iterator[str]:
    """All of a compiled function, constant or name that is in the machine code."""
    if isinstance(value, Dispatcher):
        first = id(value) not in visited
        yield f"function {visited.setdefault(id(value), len(visited))}"
        if first:
            function, options = value.py_func, value.targetoptions
            cells = [cell.cell_contents for cell in function.__closure__ or ()]
            names = dict(zip(function.__code__.co_freevars, cells, strict=True))
            defaults = [function.__defaults__, sorted((function.__kwdefaults__ or {}).items())]
            yield from _described([(name, options[name]) for name in sorted(options)], visited)
            yield from _described(defaults, visited)
            yield from _of_code(function.__code__, {**function.__globals__, **names}, visited)
    elif isinstance(value, tuple | list):
        yield f"{type(value).__qualname__} {len(value)} {getattr(value, '_fields', '')}"
        for element in value:
            yield from _described(element, visited)
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    elif isinstance(value, set | frozenset):
        yield f"set {sorted(map(repr, value))}"
    elif callable(value) and hasattr(value, "__name__"):  # which numba itself compiles
        fields = getattr(value, "_fields", "")
        yield f"{getattr(value, '__module__', 'numpy')}.{value.__name__} {fields}"
    elif value is None or value is ... or isinstance(value, _CONSTANTS):
        yield repr(value)
    elif not isinstance(value, ModuleType):  # of which what is used is described
        raise TypeError(f"Invalid {value!r} in a compiled function. Must be a number, or compiled.")


def _of_code(code: CodeType, names: Mapping[str, Any], visited: dict[int, int]) -> Iterator[str]:
    """Instructions, constants and names of code, which depend on no comment or line."""
    yield f"{code.co_code.hex()} {code.co_exceptiontable.hex()} {code.co_varnames}"
    yield f"{code.co_argcount} {code.co_kwonlyargcount} {code.co_names}"
    for place, constant in enumerate(code.co_consts):
        if isinstance(constant, CodeType):
            yield from _of_code(constant, names, visited)
        elif place or not isinstance(constant, str):  # the first text is the docstring
            yield from _described(constant, visited)
    for name in (*code.co_names, *code.co_freevars):
        value = names.get(name)
        yield from _described(value, visited)
        if isinstance(value, ModuleType | type):
            taken = map(vars(value).get, code.co_names)
            yield from _described([it for it in taken if isinstance(it, _USED)], visited)
