"""Outcome of one hostile input, judged without the code under attack."""

import re
import signal
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
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


@dataclass(frozen=True)
class Verdict:
    """What became of an input, of `GOOD`, `BAD` or `LIMIT`, with its pixels without a flag."""

    kind: str
    note: str = ""
    unflagged: int = 0
    wrong: int = 0  # of the unflagged
    what: str = ""


def wrong(note: str, *, where: bool = True) -> Verdict:
    """Silent, if it is so."""
    return Verdict("silent", note, 1, 1) if where else Verdict("right")


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

    def missing(self, text: str) -> list[str]:
        """Names that a text should contain, and does not."""
        low = text.lower()
        return [one for one in self.names if not any(n in low for n in one.lower().split("|"))]


class Late(BaseException):
    """The input took longer than `SECONDS`."""


def carry_out(attack: Attack) -> Verdict:
    """Make the attack, and judge what happens."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak begins here
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
    if verdict.kind in (*GOOD, "silent") and used > MEGABYTES:
        verdict = Verdict("memory", f"{used:.0f} MB")
    if verdict.kind in GOOD and leaked:
        # A warning that names the thing is a flag, any other one leaks from a library.
        texts = [f"{one.category.__name__}: {one.message}" for one in leaked]
        unnamed = [text for text in texts if not attack.names or attack.missing(text)]
        verdict = Verdict("warning", unnamed[0]) if unnamed else Verdict("flagged", texts[0])
    return replace(verdict, what=attack.what)


def _verdict(attack: Attack) -> Verdict:
    signal.signal(signal.SIGPROF, _stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        result = attack.act()
    except Late:
        return Verdict("hang", f"more than {SECONDS} s of the processor")
    except MemoryError as error:
        return Verdict("memory", str(error))
    except Exception as error:  # noqa: BLE001 - every error is an outcome
        return _refusal(error, attack)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return attack.judge(result)


def _stop(*_: object) -> None:
    raise Late


def _refusal(error: Exception, attack: Attack) -> Verdict:
    """Judge an error: it is of a documented kind, raised by the package, and names the thing."""
    text, frame = f"{type(error).__name__}: {error}", traceback.extract_tb(error.__traceback__)[-1]
    place = f"{frame.filename}:{frame.lineno}"
    if isinstance(error, Warning):
        return Verdict("warning", f"{text} [{place}]")
    documented = isinstance(error, _REFUSALS)
    documented &= not isinstance(error, (LookupError, ArithmeticError))
    # Some functions look things up by name, and say so.
    documented |= isinstance(error, KeyError) and "Must" in text
    ours = _OURS.search(place) or (isinstance(error, OSError) and error.filename)
    missing = attack.missing(str(error))
    if documented and ours and not missing:
        return Verdict("rejected" if attack.good else "refused", text)
    return Verdict("traceback", f"{text} [{place}]; names missing: {missing}")


def _memory(name: str) -> float:
    """Resident memory of this process, or its peak [MB]."""
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii"))
    return int(found[1]) / 1024 if found else 0.0
