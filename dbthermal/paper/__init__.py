"""The paper's published numbers and figures, one by one, beside what is measured here.

Source of all published numbers: Narayanan, Ramanagopal, Narasimhan (2026), Dual Band Thermal
Videography, CVPR, doi:10.48550/arXiv.2509.11334. Its captures are not public: what is measured
here is of simulations, of simulated twins of its scenes, of spectral libraries and of its
published videos, and every row says of which.
"""

from dbthermal.paper.published import EMISSIVITIES, PEAKS, REDUCTIONS, SCENE_ERRORS
from dbthermal.paper.row import Numbers, Row
from dbthermal.paper.table import COLUMNS, compare, markdown, rows

__all__ = [
    "COLUMNS",
    "EMISSIVITIES",
    "PEAKS",
    "REDUCTIONS",
    "SCENE_ERRORS",
    "Numbers",
    "Row",
    "compare",
    "markdown",
    "rows",
]
