"""Command line of the attack; see the package."""

import argparse
import os
import re
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

from attack.runner import CLASSES, attack_all, only, table

_MARKS = ("<!-- attack: begin -->", "<!-- attack: end -->")


def main() -> int:
    """Attack, print the table and the bad ones; exit status 1 if there is a silent one."""
    parser = argparse.ArgumentParser(prog="python -m attack", description=__doc__)
    parser.add_argument("--inputs", type=int, default=300, help="number of inputs, of all classes")
    parser.add_argument("--seed", type=int, default=1, help="first seed of every class")
    parser.add_argument("--only", help="class, or class:seed to repeat one input")
    parser.add_argument("--write", type=Path, help="page whose marked table is written anew")
    options = parser.parse_args()
    name, _, seed = (options.only or "").partition(":")
    if seed:
        print(only(name, int(seed)))
        return 0
    names = [one for one in CLASSES if one in (name or one)]
    start, tallies = time.monotonic(), {}
    for one, tally in attack_all(names, options.inputs, options.seed):
        tallies[one] = tally
        print(f"{one}: {tally.counts()} {tally.seconds:.0f} s", flush=True)
    lines = table(tallies)
    print("\n".join(lines), f"\n{time.monotonic() - start:.0f} s")
    for tally in tallies.values():
        print("\n".join(tally.bad_lines()), end="\n" if tally.bad else "")
    if options.write:
        write(options.write, lines, f"--inputs {options.inputs} --seed {options.seed}")
    return int(any(kind == "silent" for tally in tallies.values() for _, kind, _ in tally.bad))


def write(page: Path, lines: list[str], command: str) -> None:
    """Put a table between the marks of a page."""
    begin, end = _MARKS
    data = ", with the public spectra" if os.environ.get("DBTHERMAL_DATA") else ""
    git = ["git", "-C", str(page.resolve().parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    stamp = f"{datetime.now(UTC):%Y-%m-%d}, commit {commit or 'unknown'}"
    said = f"`python -m attack {command}`{data}, {stamp}:"
    text = "\n".join([begin, said, "", *lines, "", end])
    content = page.read_text(encoding="utf-8")
    marked = re.compile(f"{begin}.*{end}", re.DOTALL)
    page.write_text(marked.sub(lambda _: text, content), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
