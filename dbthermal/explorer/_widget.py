"""Explorer in JupyterLab: answers its page, pixels as binary messages and never in traits."""

import base64
import io
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import anywidget
import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib import colormaps

from dbthermal import schema
from dbthermal._arrays import Mask
from dbthermal.explorer import _export
from dbthermal.explorer._films import FILMS, Region, Values
from dbthermal.explorer._view import COMPLETED, View
from dbthermal.figures import drawing, legend

PALETTES: Final = ("inferno", "cividis", "gray", "gnuplot2", "turbo")
_DPI: Final = 80
_REFUSED: Final = (ArithmeticError, LookupError, MemoryError, OSError, TypeError, ValueError)


def quantised(values: Values, low: float, high: float) -> npt.NDArray[np.uint8]:
    """Places in a palette: 1 to 255 from the low to the high end of a range, 0 without a value."""
    with np.errstate(invalid="ignore", over="ignore"):
        codes = (values - np.float32(low)) * np.float32(255.0 / (high - low)) + np.float32(1.0)
    return np.where(schema.measured(values), np.clip(codes, 1.0, 255.0), 0.0).astype(np.uint8)


def extremes(values: Values, measured: Mask) -> list[tuple[int, int, float]]:
    """Row, column and value of the coldest and the hottest measured pixel, if any is measured."""
    valid = np.where(measured & np.isfinite(values), values, np.nan)
    if not np.isfinite(valid).any():
        return []
    places = [np.unravel_index(find(valid), valid.shape) for find in (np.nanargmin, np.nanargmax)]
    return [(int(row), int(column), float(valid[row, column])) for row, column in places]


class Explorer(anywidget.AnyWidget):
    """Explorer of a `View` in a notebook; see `dbthermal.explore`.

    Parameters
    ----------
    view, celsius : View, bool
        What is shown, later in `view` beside the `regions` by name, as they are drawn; True for
        degrees Celsius instead of kelvin.
    """

    _esm, _css = (Path(__file__).with_name(f"explorer.{kind}") for kind in ("js", "css"))

    def __init__(self, view: View, *, celsius: bool = True) -> None:
        self.view = view
        self.regions: dict[str, Region] = {}
        self._celsius, self._range = celsius, cache(view.limits)  # range of colour of a pane
        self._state: dict[str, Any] = {"index": view.time.size // 2, "pixels": "unflagged"}
        super().__init__()
        self.on_msg(self._on_message)

    def curves(self, name: str = "") -> xr.Dataset:
        """Curves over (region, time) of the regions drawn, as `View.curve`; ValueError without."""
        name = name or self._state.get("pane") or next(iter(self.view.panes))
        return _export.curves(self.view, name, self.regions, self._state["pixels"])

    def _repr_mimebundle_(self, **options: Any) -> Any:
        """Show the widget, or a static picture where widgets are not available."""
        bundle = super()._repr_mimebundle_(**options)
        data = bundle[0] if isinstance(bundle, tuple) else bundle
        if data is not None:
            data["image/png"] = self._picture()
        return bundle

    def _picture(self) -> str:
        """Object temperature or the inputs at a frame, and the maps, as PNG in base64."""
        view, panes = self.view, self.view.panes
        films = [name for name in panes if name.startswith("input ")]
        names = ["object_temperature"] if "object_temperature" in panes else films
        names += [name for name in panes if name == "status" or name.startswith("emissivity ")]
        shown = _export.Shown(names, self._state["index"], {}, self._celsius)
        buffer = io.BytesIO()
        _export.figure(view, shown).savefig(buffer, dpi=_DPI)
        return base64.b64encode(buffer.getvalue()).decode()

    def _on_message(self, _: object, content: dict[str, Any], __: Sequence[object]) -> None:
        """Answer a request of the page; an error is an answer, too."""
        key = {name: content.get(name) for name in ("page", "kind")}
        self.view.progress = lambda text, share: self.send(
            {**key, "progress": f"{text}: {100 * share:.0f} %"}
        )
        try:
            answer, buffers = getattr(self, f"_answer_{content.get('kind')}")(content)
        except _REFUSED as error:
            answer, buffers = {"error": f"{error}"}, []
        finally:
            self.view.progress = None
        self.send({**answer, **key}, [np.asarray(buffer).tobytes() for buffer in buffers])

    def _answer_start(self, _: dict[str, Any]) -> tuple[dict[str, Any], list[Any]]:
        """Answer panes, times, events and legend; palettes and classes of pixels."""
        view = self.view
        codes, entries = legend(xr.DataArray(view.status))
        panes = [
            {
                **{key: getattr(pane, key) for key in ("name", "label", "kind", "absolute")},
                "units": pane.units if pane.units != "1" else "",
                "shown": "_std" not in pane.name or pane.name == f"{next(iter(FILMS))}_std",
            }
            for pane in view.panes.values()
        ]
        classes = np.where(view.status == 0, 0, np.where((view.status & COMPLETED) != 0, 1, 2))
        palettes = [colormaps[name](range(256), bytes=True) for name in PALETTES]
        return {
            "panes": panes,
            "shape": view.shape,
            "time": [round(float(entry), 6) for entry in view.time],
            "events": view.events,
            "legend": entries,
            "palettes": PALETTES,
            "colors": drawing.COLORS,
            "celsius": self._celsius,
            "index": self._state["index"],
            "regions": [[name, entry.kind, entry.points] for name, entry in self.regions.items()],
            "note": drawing.provenance_note(view.data).strip(" ()"),
        }, [classes.astype(np.uint8), codes, *palettes]

    def _answer_frames(self, request: dict[str, Any]) -> tuple[dict[str, Any], list[Any]]:
        """Answer panes at a frame, and on which side of an isotherm their pixels are."""
        names, level, less = request["panes"], request["isotherm"], request.get("reference")
        frames = {name: self._frame(name, request) for name in names}
        limits = [*zip(names, request["limits"], strict=True)]
        ranges = {name: limit or self._range(name) for name, limit in limits}
        # Differences from a frame of reference lie about 0.
        for name, limit in limits if less is not None else ():
            if limit is None and self.view.panes[name].kind == "film":
                reach = 0.5 * (self._range(name)[1] - self._range(name)[0])
                ranges[name] = (-reach, reach)
        # The isotherm is drawn on temperatures alone.
        lined = names if level is not None and less is None else []
        lined = [name for name in lined if self.view.panes[name].absolute]
        shown = [frames[name] for name in lined]
        sides = [np.where(schema.measured(it), 1 + (it > level), 0).astype("u1") for it in shown]
        self._state["index"] = request["index"]
        measured = self.view.counted("measured")
        spots = {name: extremes(frames[name], measured) for name in names if name in FILMS}
        answer = {"index": request["index"], "panes": names, "lined": lined, "spots": spots}
        codes = [quantised(frames[name], *ranges[name]) for name in names]
        return {**answer, "ranges": [*ranges.values()]}, [*codes, *sides]

    def _frame(self, name: str, request: dict[str, Any]) -> Values:
        """Frame of a pane; of a film its difference from the reference frame, if stated."""
        frame, less = self.view.frame(name, request["index"]), request.get("reference")
        if less is None or self.view.panes[name].kind != "film":
            return frame
        return np.asarray(frame - self.view.frame(name, less))

    def _answer_profile(self, request: dict[str, Any]) -> tuple[dict[str, Any], list[Any]]:
        """Answer the values of a pane along a line, about one for each pixel."""
        start, stop = np.array(request["points"])
        number = int(np.ceil(np.abs(stop - start).max())) + 1
        places = np.linspace(start, stop, number).astype(int)
        rows, columns = np.clip(places, 0, np.array(self.view.shape) - 1).T
        return {}, [self._frame(request["pane"], request)[rows, columns].astype(np.float32)]

    def _answer_probe(self, request: dict[str, Any]) -> tuple[dict[str, Any], list[Any]]:
        """Answer values and flags of a pixel."""
        place = [request[name] for name in ("index", "row", "column")]
        answer = self.view.probe(request["panes"], *place)
        for name in answer["values"] if request.get("reference") is not None else ():
            value = float(self._frame(name, request)[place[1], place[2]])
            if self.view.panes[name].kind == "film":  # a difference, without its deviation
                answer["values"][name] = (value if np.isfinite(value) else None, None)
        return {**answer, "at": place}, []

    def _answer_curves(self, request: dict[str, Any]) -> tuple[dict[str, Any], list[Any]]:
        """Answer the curves of all regions in a pane."""
        drawn = request["regions"]
        self.regions = {name: Region(kind, tuple(map(tuple, line))) for name, kind, line in drawn}
        self._state |= {"pixels": request["pixels"], "pane": request["pane"]}
        buffers, counts = [], []
        for region in self.regions.values():
            curve = self.view.curve(request["pane"], region, pixels=request["pixels"])
            values = [np.atleast_1d(curve[name]) for name in ("mean", "minimum", "maximum", "std")]
            buffers.append(np.array(values, dtype=np.float32))
            counts.append((int(region.mask(self.view.shape).sum()), int(curve["pixels"].max())))
        return {"pane": request["pane"], "names": list(self.regions), "counts": counts}, buffers

    def _answer_event(self, request: dict[str, Any]) -> tuple[dict[str, Any], list[Any]]:
        """Answer the events, with a new one."""
        self.view.events[str(request["name"])] = float(request["time"])
        return {"events": self.view.events}, []

    def _answer_code(self, request: dict[str, Any]) -> tuple[dict[str, Any], list[Any]]:
        """Answer Python that gives the frame and the curves again."""
        place = request["panes"][0], request["index"]
        return {"text": self.view.code(*place, self.regions, request["pixels"])}, []

    def _answer_export(self, request: dict[str, Any]) -> tuple[dict[str, Any], list[Any]]:
        """Answer a file of what is seen."""
        shown = _export.Shown(
            names=request["panes"],
            regions=self.regions,
            limits={name: tuple(pair) for name, pair in request["limits"].items()},
            **{name: request[name] for name in ("index", "celsius", "pixels", "palette")},
        )
        with TemporaryDirectory() as folder:
            path = Path(folder) / f"explored{request['suffix']}"
            _export.save(self.view, path, shown)
            return {"name": path.name}, [np.frombuffer(path.read_bytes(), dtype=np.uint8)]
