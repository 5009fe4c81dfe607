"""The view of a recording while it goes on: one figure, shown in place."""

import io
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

from dbthermal.instruments.live._watch import FFC, FPA, WINDOW, Status, Watch, celsius, ffc_state
from dbthermal.instruments.recording import Preview

if TYPE_CHECKING:  # matplotlib is loaded with the first picture: a `Watch` does without it
    from matplotlib.figure import Figure

    from dbthermal.figures import LiveFigure

PERIOD: Final = 1.0
"""Least time from picture to picture [s]; one takes a tenth of it, see `View`."""

_COMPRESSION: Final = 1  # of zlib's 1 to 9


class Display(Protocol):
    """What a picture is shown with; IPython's ``DisplayHandle`` is one."""

    def display(self, obj: Any, /) -> Any:
        """Show it where the cell's output is."""
        ...

    def update(self, obj: Any, /) -> Any:
        """Show it in place of the one before."""
        ...


@dataclass(frozen=True, eq=False)
class Picture:
    """
    What a `Display` is handed: a picture for a notebook, a text for a terminal.

    Attributes
    ----------
    png : bytes
        The figure, PNG.
    text : str
        The same in words.
    """

    png: bytes
    text: str

    def __repr__(self) -> str:
        return self.text

    def _repr_png_(self) -> bytes:
        """Give what IPython shows."""
        return self.png


class View:
    """
    Show a recording while it goes on; an instance is the `preview` of a recording, or of several.

    One update of two bands of 640 x 512 takes about a tenth of a second of one core, between two
    frames that are written; the fetching threads go on meanwhile.

    Parameters
    ----------
    display : Display, optional
        Where it is shown; without one the figure is only kept.
    is_simulated : bool
        Whether the cameras are emulated, which a preview does not say; the title does.
    title : str
        What is recorded.
    period : float
        Least time from update to update [s].
    window : float
        Time over which frame rates are measured [s].

    Raises
    ------
    ValueError
        If `period` is negative or not finite, or `window` not positive.
    """

    def __init__(
        self,
        display: Display | None = None,
        *,
        is_simulated: bool,
        title: str = "recording",
        period: float = PERIOD,
        window: float = WINDOW,
    ) -> None:
        if not 0 <= period < math.inf:
            raise ValueError(f"Invalid period {period} s. Must be 0 or more.")
        self._display, self._period = display, period
        self._title = f"{title} (emulated)" if is_simulated else title
        self._watch = Watch(window)
        self._drawn: LiveFigure | None = None
        self._is_shown, self._time = False, -math.inf

    @property
    def figure(self) -> "Figure | None":
        """The figure as it was last drawn, None before the first preview."""
        return self._drawn.figure if self._drawn else None

    @property
    def status(self) -> dict[str, Status]:
        """Band to its `Status` at the last preview, whether it was drawn or not."""
        return self._watch.status()

    def __call__(self, preview: Preview) -> None:
        """
        Take a preview; show it if the one shown last is old enough, or of another recording.

        Nothing is drawn before the first frame: only a frame knows how large a picture is.

        Parameters
        ----------
        preview : Preview
            What there is to show.
        """
        if self._watch.note(preview):
            self._time = -math.inf
        if preview.frames and preview.time - self._time >= self._period:
            self._time = preview.time
            self._show(preview)

    def _show(self, preview: Preview) -> None:
        from dbthermal.figures import Panel  # noqa: PLC0415 - loads matplotlib

        status, frames = self._watch.status(), preview.frames
        panels = {
            band: Panel(
                frames[band].counts if band in frames else None,
                _apart(one.limits),
                one.text,
                one.warning,
            )
            for band, one in status.items()
        }
        title, foot = f"{self._title}, {preview.time:.1f} s", _foot(preview)
        drawn = self._figure_for(preview)
        drawn.update(panels, title=title, foot=foot)
        if self._display is not None:
            lines = [f"{band}: {one.text}\n{one.warning}" for band, one in status.items()]
            text = "\n".join((title, *lines, foot))
            self._hand_over(self._display, Picture(_png(drawn), text))

    def _figure_for(self, preview: Preview) -> "LiveFigure":
        """Give the figure, another one only for other bands or another shape."""
        from dbthermal.figures import LiveFigure  # noqa: PLC0415 - loads matplotlib

        bands, drawn = tuple(preview.totals), self._drawn
        shape = next(iter(preview.frames.values())).counts.shape
        if drawn is None or (drawn.bands, drawn.shape) != (bands, shape):
            drawn = self._drawn = LiveFigure(bands, shape)
        return drawn

    def _hand_over(self, display: Display, picture: Picture) -> None:
        if self._is_shown:
            display.update(picture)
        else:
            display.display(picture)
            self._is_shown = True


def _apart(limits: tuple[float, float]) -> tuple[float, float]:
    """Black and white, apart even where all counts are equal; 0 and 1 where there are none."""
    low, high = limits
    if math.isnan(low):
        return 0.0, 1.0
    return low, max(high, low + 1.0)


def _foot(preview: Preview) -> str:
    """Readings that belong to no band that is shown: of thermocouples, of the blackbody."""
    used = {prefix + band for prefix in (FPA, FFC) for band in preview.totals}
    return ", ".join(
        f"{name} {_reading(name, value, preview.units.get(name, 'K'))}"
        for name, value in preview.readings.items()
        if name not in used
    )


def _reading(name: str, value: float, unit: str) -> str:
    if name.startswith(FFC):
        return ffc_state(value)
    if math.isnan(value):
        return "no answer"
    if unit == "K":
        return celsius(value)
    return f"{value:g}" if unit == "1" else f"{value:g} {unit}"


def _png(drawn: "LiveFigure") -> bytes:
    """Write the figure as PNG, fast rather than small."""
    from matplotlib.image import imsave  # noqa: PLC0415 - see the module's imports

    buffer = io.BytesIO()
    imsave(buffer, drawn.pixels(), format="png", pil_kwargs={"compress_level": _COMPRESSION})
    return buffer.getvalue()
