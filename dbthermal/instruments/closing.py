"""What all devices and lines have in common: they are closed at the end of a ``with``."""

from types import TracebackType
from typing import Self


class Closing:
    """
    Context manager that closes at its end, without hiding what went wrong in it.

    A failure to close is raised if nothing went wrong before, and else noted on what did.
    """

    def close(self) -> None:
        """Give back what is held; a second time does nothing."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except (OSError, RuntimeError) as closing:
            if error is None:
                raise
            error.add_note(f"Closing failed too. {closing}")
