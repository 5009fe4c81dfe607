"""The paper's published numbers and figures, one by one, beside ours.

Source of all published numbers: Narayanan, Ramanagopal, Narasimhan (2026), Dual Band Thermal
Videography, CVPR, doi:10.48550/arXiv.2509.11334. Its captures are not public: ours are
of simulations, of simulated twins of its scenes, of spectral libraries and of its published
videos, and every row says of which.
"""

from reproduction.paper.published import EMISSIVITIES, PEAKS, REDUCTIONS, SCENE_ERRORS, Numbers, Row
from reproduction.paper.table import COLUMNS, compare, markdown, rows

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
