"""Outcome of one hostile input, judged without the code under attack."""

import re
import signal
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Final

import dbthermal
import reproduction

GOOD: Final = ("right", "refused", "flagged")
"""Right within the stated deviations; refused by an error that names the thing; all flagged."""

BAD: Final = ("silent", "traceback", "warning", "memory", "hang", "crash", "rejected")
"""Wrong without a word; another error, or one that names nothing; a library's warning that leaks;
too much memory or time; the end of the process; good input refused."""

LIMIT: Final = "limit"
"""Wrong without a word, where docs/trust.md says that nothing in the input shows it."""

SECONDS: Final = 60
MEGABYTES: Final = 500
"""Bounds of one input, in time of the processor and beyond the memory held before it; inputs are a
few MB. A machine that is busy with other work makes nothing late."""

_REFUSALS: Final = (ValueError, TypeError, OSError)
# Of the libraries, those that name what does not fit: a model's field, a coordinate.
_ROOMS: Final = [re.escape(f"{Path(str(m.__file__)).parent}/") for m in (dbthermal, reproduction)]
_OURS: Final = re.compile("|".join([*_ROOMS, "/pydantic/|/xarray/structure/alignment"]))
_WORK: Final = ("right", "refused", "flagged", "silent")


@dataclass(frozen=True)
class Verdict:
    """What became of an accepted input, with its pixels without a flag and the wrong ones."""

    kind: str
    note: str = ""
    unflagged: int = 0
    wrong: int = 0


@dataclass(frozen=True)
class Attack:
    """
    One hostile input: what is wrong with it, the call, and the judge of what the call returns.

    A refusal must contain one of the texts of each entry in `names`, parted by ``|``. `good` input
    must be accepted. `limit` is why nothing in the input shows that it is wrong, if so.
    """

    what: str
    act: Callable[[], Any]
    judge: Callable[[Any], Verdict]
    names: tuple[str, ...] = ()
    good: bool = False
    limit: str = ""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one input, of `GOOD` or `BAD`."""

    kind: str
    what: str
    note: str = ""
    megabytes: float = 0.0
    unflagged: int = 0
    wrong: int = 0


class Late(BaseException):
    """The input took longer than `SECONDS`."""


def carry_out(attack: Attack) -> Outcome:
    """Make the attack, and judge what happens."""
    _reset_peak()
    before = _memory("VmRSS")
    with warnings.catch_warnings(record=True) as leaked:
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", ResourceWarning)
        warnings.simplefilter("error", RuntimeWarning)
        verdict = _verdict(attack)
    used = _memory("VmHWM") - before
    if verdict.kind == "silent" and attack.limit:
        verdict = Verdict(LIMIT, attack.limit)
    if verdict.kind in _WORK and used > MEGABYTES:
        verdict = Verdict("memory", f"{used:.0f} MB")
    if verdict.kind in GOOD and leaked:
        verdict = _warned(leaked, attack)
    return Outcome(verdict.kind, attack.what, verdict.note, used, verdict.unflagged, verdict.wrong)


def _warned(leaked: list[warnings.WarningMessage], attack: Attack) -> Verdict:
    """A warning that names the thing is a flag, any other one leaks from a library."""
    texts = [f"{one.category.__name__}: {one.message}" for one in leaked]
    unnamed = [text for text in texts if not attack.names or _missing(text, attack)]
    return Verdict("warning", unnamed[0]) if unnamed else Verdict("flagged", texts[0])


def _missing(text: str, attack: Attack) -> list[str]:
    """Names that a text should contain, and does not."""
    low = text.lower()
    return [one for one in attack.names if not any(n in low for n in one.lower().split("|"))]


def _verdict(attack: Attack) -> Verdict:
    try:
        with _within(SECONDS):
            result = attack.act()
    except Late:
        return Verdict("hang", f"more than {SECONDS} s of the processor")
    except MemoryError as error:
        return Verdict("memory", str(error))
    except Warning as error:
        return Verdict("warning", f"{type(error).__name__}: {error} {_place(error)}")
    except Exception as error:  # noqa: BLE001 - every error is an outcome
        return refusal(error, attack)
    return attack.judge(result)


def refusal(error: Exception, attack: Attack) -> Verdict:
    """Judge an error: it is of a documented kind, raised by the package, and names the thing."""
    text = f"{type(error).__name__}: {error}"
    other = isinstance(error, (LookupError, ArithmeticError))
    documented = isinstance(error, _REFUSALS) and not other
    # Some functions look things up by name, and say so.
    documented |= isinstance(error, KeyError) and "Must" in text
    missing = _missing(str(error), attack)
    where = _place(error)
    if not documented or missing:
        rule = f"; names none of '{missing[0]}'" if missing else ""
        return Verdict("traceback", f"{text} {where}{rule}")
    if not _OURS.search(where) and not (isinstance(error, OSError) and error.filename):
        return Verdict("traceback", f"{text} {where}; not the package's own words")
    return Verdict("rejected" if attack.good else "refused", text)


def _place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    return f"[{frames[-1].filename}:{frames[-1].lineno}]" if frames else "[]"


@contextmanager
def _within(seconds: float) -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        raise Late(number, frame)

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def _reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def _memory(name: str) -> float:
    """Resident memory of this process, or its peak since the reset [MB]."""
    text = Path("/proc/self/status").read_text(encoding="ascii")
    found = re.search(rf"{name}:\s+(\d+) kB", text)
    return int(found[1]) / 1024 if found else 0.0
