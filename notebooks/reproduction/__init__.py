"""The reproduction of the paper: its scenes, experiments and tables."""

import sys

# nbformat's jsonschema would build a grammar of international addresses (IRI) for a second; no
# notebook has any.
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
