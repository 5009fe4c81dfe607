"""Command line of the attack; see the package."""

import argparse
import os
import re
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

from attack.runner import CLASSES, attack_all, bad, only, table


def main() -> int:
    """Attack, print the table and the bad ones; exit status 1 if there is a silent one."""
    parser = argparse.ArgumentParser(prog="python -m attack", description=__doc__)
    parser.add_argument("--inputs", type=int, default=300, help="number of inputs, of all classes")
    parser.add_argument("--seed", type=int, default=1, help="first seed of every class")
    parser.add_argument("--only", default="", help="class, or class:seed to repeat one input")
    parser.add_argument("--write", type=Path, help="page whose marked table is written anew")
    options = parser.parse_args()
    name, _, seed = options.only.partition(":")
    if seed:
        print(only(name, int(seed)))
        return 0
    found = {}
    chosen = [it for it in CLASSES if it in (name or it)]
    for one, verdicts in attack_all(chosen, options.inputs, options.seed):
        found[one] = verdicts
        print(
            *bad(one, options.seed, verdicts),
            f"{one}: {len(verdicts)} inputs",
            sep="\n",
            flush=True,
        )
    print(*table(found), sep="\n")
    if options.write:
        write(options.write, table(found), f"--inputs {options.inputs} --seed {options.seed}")
        promises = options.write.with_name("trust.md")
        text = counted(promises.read_text("utf-8"), options.write.read_text("utf-8"))
        promises.write_text(text, encoding="utf-8")
    return int(any(one.kind == "silent" for some in found.values() for one in some))


def write(page: Path, lines: list[str], command: str) -> None:
    """Put a table between the marks of a page."""
    begin, end = "<!-- attack: begin -->", "<!-- attack: end -->"
    data = ", with the public spectra" if os.environ.get("DBTHERMAL_DATA") else ""
    git = ["git", "-C", str(page.resolve().parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    stamp = f"{datetime.now(UTC):%Y-%m-%d}, commit {commit or 'unknown'}"
    text = "\n".join([begin, f"`python -m attack {command}`{data}, {stamp}:", "", *lines, "", end])
    marked = re.compile(f"{begin}.*{end}", re.DOTALL)
    page.write_text(marked.sub(lambda _: text, page.read_text(encoding="utf-8")), encoding="utf-8")


def counted(promises: str, attacks: str) -> str:
    """Promises with the counts of a table of attacks, as "`bits` 259 of 259" that ended well."""
    row = re.compile(r"^\| `(\w+)` \| (\d+) \|(.*?)\|(.*?)\|(.*?)\|", re.MULTILINE)
    for name, *cells in row.findall(attacks):
        inputs, *good = (int(cell.strip() or 0) for cell in cells)
        count = f"`{name}` {sum(good)} of {inputs}"
        promises = re.sub(rf"`{name}` \d+ of \d+", count, promises)
    return promises


if __name__ == "__main__":
    sys.exit(main())
