"""Nomenclature: the glossary of `dbthermal.schema` as a page, printed for nomenclature.md."""

import sys
from collections.abc import Mapping
from typing import Final

from dbthermal import schema

_PREFACE: Final = """# Nomenclature

Variables at each stage of the data stream. This page is made from `dbthermal.schema` by
`python docs/nomenclature.py > docs/nomenclature.md`. Temperatures are in kelvin, other units are
SI; `count` is the unit of the detector's signal. A variable in italics is optional. "std" is short
for standard deviation.

The *reference band* is the band with the least noise; e is the emissivity of a band, e_ref that of
the reference band. The *reflection ratio* of a band is its reflectivity over that of the reference
band. The *background ratio* is the change of the reflected temperature in a band over that in the
reference band. `drift_std` is of the emissivity in the reference band."""


def nomenclature() -> str:
    """Glossary as Markdown, the text of docs/nomenclature.md."""
    parts = [_PREFACE, "## Coordinates", _table(schema.COORDINATES)]
    for stage, variables in schema.STAGES.items():
        parts += [
            f"## Stage `{stage}`",
            _table({**variables, **schema.OPTIONAL.get(stage, {})}, stage),
        ]
    bits = [f"| {bit.value} | `{bit.label}` | {bit.meaning} |" for bit in schema.Status]
    head = ["| value | name | meaning |", "| --: | --- | --- |"]
    return "\n\n".join([*parts, "## Bits of `status`", "\n".join([*head, *bits])]) + "\n"


def _table(variables: Mapping[str, schema.Variable], stage: str = "") -> str:
    """Markdown table of variables; the optional ones of a stage in italics."""
    rows = ["| variable | dimensions | type | unit | meaning |", "| --- | --- | --- | --- | --- |"]
    optional = schema.OPTIONAL.get(stage, {})
    for name, one in variables.items():
        label = f"*{name}*" if name in optional else f"`{name}`"
        dims = ", ".join(one.dims) or "-"
        rows.append(f"| {label} | {dims} | {one.dtype} | {one.units} | {one.long_name} |")
    return "\n".join(rows)


if __name__ == "__main__":
    sys.stdout.write(nomenclature())
