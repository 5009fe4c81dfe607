"""The reproduction of the paper: its scenes, experiments and tables."""

import sys

# What checks a notebook's file would build a grammar of web addresses first: a second of each run.
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]
