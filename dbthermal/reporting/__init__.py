"""Reports: one HTML file that opens anywhere, without a network, and holds all that it shows.

`report` tells of one separated scene; `save_page` lays out other sections in the same way.
"""

from dbthermal.reporting._page import Section, film_tag, image_tag, save_page, table
from dbthermal.reporting._scene import report

__all__ = ["Section", "film_tag", "image_tag", "report", "save_page", "table"]
__dir__ = __all__.copy
