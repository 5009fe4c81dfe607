"""Page of a report: sections of text, tables, figures and films in one file of HTML."""

import base64
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
from matplotlib.figure import Figure

from dbthermal import _text as texts
from dbthermal import store
from dbthermal._text import missing_library

try:
    from jinja2 import Environment, select_autoescape
    from jinja2.utils import htmlsafe_json_dumps
    from markupsafe import Markup
except ImportError as error:
    raise ImportError(missing_library(error.name, "report")) from error

_LOGO: Final = 2**20  # largest picture beside the title [byte]

# The poster is the picture that is printed; the button lies below the film and hides none of it.
_FILM: Final = Markup("""{
  const figure = document.currentScript.parentElement, button = figure.querySelector("button");
  const [film, still] = [figure.querySelector("video"), figure.querySelector("img")];
  if (still) film.poster = still.src;
  button.onclick = film.onclick = () => (film.paused ? film.play() : film.pause());
  film.onplay = film.onpause = () => {
    button.textContent = film.paused ? "Play the film" : "Pause";
  };
}""")


@dataclass(frozen=True)
class Section:
    """Part of a page under one heading."""

    title: str
    body: Sequence[str]  # paragraphs: Markup, or plain text that is shown as it is written


def save_page(  # noqa: PLR0913 - what is above the sections, by name
    path: str | Path,
    title: str,
    sections: Iterable[Section],
    *,
    origin: str,
    numbers: Mapping[str, Any],
    provenance: Mapping[str, Any],
    about: str = "",
    answer: Sequence[str] = (),
    logo: str | Path | None = None,
) -> None:
    """Save sections as one HTML file that asks for nothing else, with its numbers as JSON in it.

    Above the sections: title, logo, origin of the data, author and files, sentences of the answer.
    """
    picture = b"" if logo is None else texts.regular_file(logo, _LOGO).read_bytes()
    if logo is not None and not picture.startswith(b"\x89PNG\r\n\x1a\n"):
        raise ValueError(f"Invalid logo '{logo}'. Must be a PNG.")
    environment = Environment(autoescape=select_autoescape(default=True), trim_blocks=True)
    text = resources.files("dbthermal.reporting").joinpath("page.html").read_text("utf-8")
    page = environment.from_string(text).render(
        title=title,
        origin=origin,
        about=about,
        answer=list(answer),
        logo=base64.b64encode(picture).decode(),
        sections=list(sections),
        numbers=htmlsafe_json_dumps(numbers, allow_nan=False, sort_keys=True),
        provenance=json.dumps(provenance, indent=2, sort_keys=True),
    )
    if Path(path).suffix != ".html":
        raise ValueError(f"Invalid path '{path}'. Must end in '.html'.")
    store.save_text(page, path, provenance)


def table(head: Sequence[str], rows: Iterable[Sequence[object]], *, names: int = 1) -> Markup:
    """Table with columns of names, to the left, and of numbers, to the right."""

    def cells(row: Sequence[object], tag: str) -> Markup:
        kinds = ("name" if index < names else "number" for index in range(len(row)))
        pairs = zip(row, kinds, strict=True)
        return Markup("").join(
            Markup("<{0} class={1}>{2}</{0}>").format(Markup(tag), kind, cell)
            for cell, kind in pairs
        )

    body = Markup("").join(Markup("<tr>{}</tr>").format(cells(row, "td")) for row in rows)
    return Markup("<table><thead><tr>{}</tr></thead><tbody>{}</tbody></table>").format(
        cells(head, "th"), body
    )


def image_tag(image: Figure, text: str) -> Markup:
    """Figure as a picture of vectors within the page, with its caption."""
    buffer = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "dbthermal", "svg.fonttype": "path"}):
        image.savefig(buffer, format="svg", metadata={"Date": None}, dpi=150)
    source = f"data:image/svg+xml;base64,{base64.b64encode(buffer.getvalue()).decode()}"
    return Markup('<figure><img src="{}" alt="{}"><figcaption>{}</figcaption></figure>').format(
        source, text, text
    )


def film_tag(path: Path, text: str, poster: Path) -> Markup:
    """Film ``*.mp4`` within the page, with its caption, and a picture ``*.png`` before it plays."""
    content, still = (base64.b64encode(file.read_bytes()).decode() for file in (path, poster))
    picture = Markup('<img src="data:image/png;base64,{}" alt="{}">').format(still, text)
    return Markup(
        '<figure class="film">{}<video loop muted playsinline src="data:video/mp4;base64,{}">'
        '</video><figcaption><button type="button">Play the film</button> {}</figcaption>'
        "<script>{}</script></figure>"
    ).format(picture, content, text, _FILM)


def viewer_tag(film: Mapping[str, Any], text: str) -> Markup:
    """Viewer of films as viewer.js reads them, with a text: picture, slider, curve of a pixel."""
    script = resources.files("dbthermal.reporting").joinpath("viewer.js").read_text("utf-8")
    return Markup(
        '<div class="viewer"><div class="controls"><select data-part="quantity"></select>'
        '<button type="button" data-part="play">Play</button>'
        '<input type="range" min="0" value="0" step="1" data-part="time" aria-label="frame"></div>'
        '<div class="readout" data-part="readout"></div><div class="scaled">'
        '<canvas data-part="picture"></canvas><canvas data-part="bar"></canvas></div>'
        '<canvas data-part="curve"></canvas><p>{}</p>'
        '<script type="application/json">{}</script><script>{}</script></div>'
    ).format(text, htmlsafe_json_dumps(film, allow_nan=False, sort_keys=True), Markup(script))
