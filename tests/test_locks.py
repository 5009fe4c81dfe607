"""The two locks pin the same packages; one of them has hashes, for the public index."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PIN = re.compile(r"^([a-z0-9-]+)==([^ ;\\\n]+)([^\\\n]*)", re.MULTILINE)
# What torch needs for accelerators is in one lock only: its CPU build, used here, needs none of it.
ACCELERATORS = re.compile("(nvidia|cuda)-.*|triton")


def pins(text: str) -> dict[str, tuple[str, str]]:
    """Version and condition of each package."""
    return {name: (version, where.strip()) for name, version, where in PIN.findall(text)}


def test_both_locks_pin_the_same() -> None:
    """Each package has one version and one condition; with hashes there are accelerators' too."""
    plain = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    hashed = (ROOT / "requirements-hashes.lock").read_text(encoding="utf-8")
    same = {n: pin for n, pin in pins(hashed).items() if not ACCELERATORS.fullmatch(n)}
    assert same == pins(plain)
    assert {"numpy", "pip", "hatchling", "torch", "uv"} <= same.keys()
    for entry in re.split(r"\n(?=[a-z])", hashed)[1:]:
        assert re.search("--hash=sha256:[0-9a-f]{64}", entry), entry
    for text in (plain, hashed):
        assert "://" not in text
