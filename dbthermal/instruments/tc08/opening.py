"""Opening a TC-08: the firmware's download, the choice among several units, their identity.

Tested against an emulated library object and a stub compiled from the public signatures, not
against hardware.
"""

import ctypes
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from dbthermal.instruments.tc08.library import Library, TC08Error, UnitInfo, load

if TYPE_CHECKING:
    from dbthermal.instruments.emulated.world import World

OPEN_TIMEOUT: Final = 30.0
"""How long opening a unit may take [s]; the library downloads its firmware first."""

_POLL = 0.05  # [s] between two looks at the progress


@dataclass(frozen=True)
class Identity:
    """
    Identity of a unit.

    Attributes
    ----------
    serial_number, calibration_date, driver : str
        As the library gives them; the date's format is the vendor's.
    hardware, variant : int
        Versions.
    is_simulated : bool
        True if the library is an emulated one.
    """

    serial_number: str
    calibration_date: str
    driver: str
    hardware: int
    variant: int
    is_simulated: bool


def open_unit(
    library: Library,
    timeout: float,
    *,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> int:
    """
    Open the next free unit.

    Parameters
    ----------
    library : Library
        That opens it.
    timeout : float
        How long it may take [s].
    clock, sleep : callable
        The host's clock [s], and waiting [s].

    Returns
    -------
    int
        Its handle, or 0 if there is none.

    Raises
    ------
    TC08Error
        If the library says why it failed.
    TimeoutError
        If it takes too long.
    """
    if not library.usb_tc08_open_unit_async():
        raise TC08Error("be opened", library.usb_tc08_get_last_error(0))
    handle, percent = (ctypes.c_int16 * 1)(), (ctypes.c_int16 * 1)()
    deadline = clock() + timeout
    while not (done := library.usb_tc08_open_unit_progress(handle, percent)):
        if clock() >= deadline:
            raise TimeoutError(
                f"The TC-08 is not open after {timeout} s, at {percent[0]} %. Must have got its "
                "firmware by then: pull it out and plug it in again."
            )
        sleep(_POLL)
    if done < 0:
        raise TC08Error("be opened", library.usb_tc08_get_last_error(0))
    return int(handle[0])


def identify(library: Library, handle: int) -> Identity:
    """
    Ask a unit what it is.

    Parameters
    ----------
    library : Library
        That opened it.
    handle : int
        Of the unit.

    Returns
    -------
    Identity
        Its identity.

    Raises
    ------
    TC08Error
        If the library fails.
    """
    unit = (UnitInfo * 1)()
    unit[0].size = ctypes.sizeof(UnitInfo)
    if not library.usb_tc08_get_unit_info(handle, unit):
        raise TC08Error("tell what it is", library.usb_tc08_get_last_error(handle))
    texts = (unit[0].serial, unit[0].calibration_date, unit[0].driver)
    serial, date, driver = (text.decode("ascii", "backslashreplace") for text in texts)
    return Identity(serial, date, driver, unit[0].hardware, unit[0].variant, is_simulated(library))


def is_simulated(library: Library) -> bool:
    """
    Tell an emulated library from the vendor's.

    Parameters
    ----------
    library : Library
        Any.

    Returns
    -------
    bool
        True if it says so; the vendor's does not know the word.
    """
    return bool(getattr(library, "is_simulated", False))


def library_of(url: str, world: "World | None" = None) -> Library:
    """
    Library that a URL names.

    Parameters
    ----------
    url : str
        ``tc08:``, ``tc08:///path/of/library.so`` or ``sim://tc08``.
    world : World, optional
        Of the emulated unit, and needed for it.

    Returns
    -------
    Library
        The vendor's, or an emulated one.

    Raises
    ------
    ValueError
        If the URL is another one, or a world is missing, or given to a real unit.
    OSError
        As `load`.
    """
    if (url == "sim://tc08") != (world is not None):
        raise ValueError(f"Invalid URL '{url}'. Must be sim://tc08 with a world, and only then.")
    if world is not None:
        module = importlib.import_module("dbthermal.instruments.emulated.tc08")
        return module.EmulatedTC08.from_world(world)
    if url != "tc08:" and not url.startswith("tc08:///"):
        raise ValueError(f"Invalid URL '{url}'. Must be tc08:, tc08:///path or sim://tc08.")
    return load(url.removeprefix("tc08:").removeprefix("//") or None)
