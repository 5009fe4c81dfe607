"""Notice that the separation is compiled, which a first run after an installation waits for."""

import sys
from typing import Final

from numba.core import event


class _Told(event.Listener):
    """Listener that says so once, when nothing that an earlier run left can be used."""

    said = False

    def on_start(self, _: event.Event) -> None:
        """Say how long it takes."""
        if not self.said:
            text = "Compiling the separation, once after an installation: about a minute.\n"
            sys.stderr.write(text)
        self.said = True

    def on_end(self, _: event.Event) -> None:
        """Say nothing more."""


_TOLD: Final = _Told()


def tell() -> None:
    """Notice it from now on."""
    event.register("numba:compile", _TOLD)  # type: ignore[no-untyped-call]
