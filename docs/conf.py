"""Settings of the documentation site, which `make docs` builds; nothing is fetched for it."""

import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from pygments.lexers.special import TextLexer
from sphinx.errors import SphinxError

import dbthermal

sys.path.insert(0, str(Path(__file__).parent))
import pages

project, release = "dbthermal", dbthermal.__version__
extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "numpydoc", "myst_nb"]
source_suffix = {".rst": "restructuredtext", ".md": "myst-nb", ".ipynb": "myst-nb"}
default_role = "autolink"
add_module_names = False
python_maximum_signature_line_length = 80
toc_object_entries_show_parents = "hide"

autosummary_generate = False  # `pages` writes the pages
autodoc_typehints = "none"  # the docstrings have shapes and units
numpydoc_show_class_members = False

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_update_mathjax = False
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_ipywidgets_js: dict[str, dict[str, str]] = {}  # they would come from outside
nb_merge_streams = True
suppress_warnings = ["mystnb.unknown_mime_type"]  # of pictures that HTML does not show

html_theme = "pydata_sphinx_theme"
html_title = "dbthermal"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_math_renderer = "mathml"
html_context = {"default_mode": "auto"}
html_theme_options = {"secondary_sidebar_items": ["page-toc"], "footer_start": [], "footer_end": []}


def document_constant(_app: object, what: str, name: str, *rest: Any) -> None:
    """Replace the docstring of a constant's type by the constant's own."""
    if what == "data":
        module, _, constant = name.rpartition(".")
        rest[-1][:] = pages.constants(module).get(constant, "").splitlines()


def write_formula(translator: Any, node: Any) -> None:
    """Write a formula as MathML, which browsers draw by themselves."""
    block = isinstance(node, nodes.math_block)
    try:
        formula = tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        raise SphinxError(
            f"{translator.builder.current_docname}: {error} {node.astext()}"
        ) from error
    translator.body.append(f'<div class="formula">{formula}</div>' if block else formula)
    raise nodes.SkipNode


def follow_links(app: Any, exception: Exception | None) -> None:
    """Fail if a link leads nowhere; list the outside ones, which are not fetched."""
    if exception is None and app.builder.format == "html":
        faults, outside = pages.check_links(Path(app.outdir))
        listed = "".join(f"{address}\n" for address in sorted(outside))
        (Path(app.outdir) / "outside_links.txt").write_text(listed, encoding="utf-8")
        if faults:
            raise SphinxError("\n".join(sorted(faults)))


def lead_to_pages(_: Any, __: str, source: list[str]) -> None:
    """Lead links to notebooks, which a reader of the files finds beside `docs`, to their pages."""
    source[0] = source[0].replace("](../notebooks/", "](notebooks/")


def setup(app: Any) -> dict[str, bool]:
    """Connect the steps above with those of Sphinx."""
    app.add_html_math_renderer("mathml", (write_formula, None), (write_formula, None))
    app.add_lexer("layers", TextLexer)
    app.connect("config-inited", lambda *_: pages.write())
    app.connect("source-read", lead_to_pages)
    app.connect("autodoc-process-docstring", document_constant, priority=100)
    # A constant's type has a signature, the constant has none.
    app.connect(
        "autodoc-process-signature", lambda _, what, *__: () if what == "data" else None, 100
    )
    app.connect("build-finished", follow_links)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
