"""The reproduction of the paper: its scenes, experiments and tables."""

import sys

# nbformat's jsonschema would build a grammar of web addresses, which no notebook has, for a second.
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
