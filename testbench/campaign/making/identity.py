"""What makes a run this run and no other: its scenario, its seed, the program, and when it ends early.

The program is the text of all packages and their data, and the versions of the packages that compute: whatever of it
changes, runs are made anew and never mixed with older ones.
"""

import hashlib
import json
from collections.abc import Iterator
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Final

from testbench.errors import BenchError

PACKAGES: Final = ("canopen_exo", "dbc", "fi_gateway", "hlc", "joint_emulators", "testbench")
COMPUTING: Final = ("mujoco", "mujoco-core", "numpy")

_SEED_LINE: Final = "\nseed: 0\n"


@cache
def code_version() -> str:
    """ "0.1.0+0123456789ab": the version, and a hash of all package sources, data and computing packages."""
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parents[3]
    for path in _sources(root):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    for name in COMPUTING:
        try:
            digest.update(f"{name} {metadata.version(name)}\n".encode())
        except metadata.PackageNotFoundError:
            continue
    return f"{metadata.version('exo-hil')}+{digest.hexdigest()[:12]}"


def _sources(root: Path) -> Iterator[Path]:
    """Every file of the packages but what Python leaves there, in an order that is the same everywhere."""
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                yield path


def identity(scenario: str, seed: int, version: str, stop_on: str | None, grace_s: float) -> str:
    """SHA-256 in hex. scenario: resolved YAML with seed 0; version: `code_version()`; the rest as in RunSpec."""
    parts = [scenario, seed, version, stop_on, grace_s if stop_on is not None else 0.0]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def with_seed(scenario: str, seed: int) -> str:
    """Resolved YAML with seed 0, with another seed."""
    if scenario.count(_SEED_LINE) != 1:
        raise BenchError("scenario without the line 'seed: 0': it is not a resolved scenario of a campaign")
    return scenario.replace(_SEED_LINE, f"\nseed: {seed}\n")
