"""Where a run's numbers come from: code, lock, inputs, parameters, versions, machine, times."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import subprocess
from collections.abc import Mapping
from datetime import datetime
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

from study.files.atomic import sha256_of
from study.files.places import CHECKOUT, PACKAGE, is_checkout

CODE = ("src", "annotations", "data_manifest.yaml", "environment.lock")  # what decides a run's numbers
DISTRIBUTION = "thoracic-cartilage-study"  # the package index's name of `study`


def provenance(
    dataset: str,
    parameters: Mapping[str, Any],
    seed: int,
    inputs: Mapping[str, str],
    started: datetime,
    finished: datetime,
    root: Path | None = None,
) -> dict[str, Any]:
    """Where a run's numbers come from.

    Args:
        dataset: its name.
        parameters: every parameter of the run; dataclasses are taken apart.
        seed: the run's seed.
        inputs: SHA-256 of each input file by name.
        started, finished: wall-clock times with a time zone.
        root: a checkout, for its commit and lock file; the running code's when None.
    """
    root = root or _root()
    lock = root / "environment.lock"
    return {
        "commit": _git(root, "rev-parse", "HEAD"),
        # Results are written inside the checkout and say nothing about the code.
        "uncommitted_changes": _git(root, "status", "--porcelain", "--", ".", ":!results", ":!notebooks"),
        "code_sha256": code_sha256(root),
        "lock_sha256": sha256_of(lock) if lock.is_file() else None,
        "inputs_sha256": dict(inputs),
        "dataset": dataset,
        "parameters": dict(parameters),
        "seed": seed,
        "versions": _versions(),
        "machine": {"platform": platform.platform(), "cores": os.cpu_count(), **_processor()},
        "started": started.isoformat(timespec="seconds"),
        "finished": finished.isoformat(timespec="seconds"),
        "seconds": (finished - started).total_seconds(),
    }


def arithmetic() -> dict[str, Any]:
    """What decides the last bits of a number beside inputs and parameters: code, versions, processor."""
    return {"code_sha256": code_sha256(), "versions": _versions(), **_processor()}


def _root() -> Path:
    """The checkout that the code runs from, or the installed package."""
    return CHECKOUT if is_checkout() else PACKAGE


def code_sha256(root: Path | None = None) -> str:
    """One SHA-256 of every file that decides a run's numbers: package, annotations, manifest and lock.

    An installed package carries all but the lock, so its own files are what is hashed there.
    """
    root = root or _root()
    if root == PACKAGE:
        return _sha256_of_files(root, [path for path in root.rglob("*") if path.is_file()])
    found = [path for name in CODE for path in (root / name, *(root / name).rglob("*")) if path.is_file()]
    return _sha256_of_files(root, found)


def _sha256_of_files(root: Path, found: list[Path]) -> str:
    files = sorted(path.relative_to(root).as_posix() for path in found if "__pycache__" not in path.parts)
    lines = [f"{sha256_of(root / name)}  {name}\n" for name in files]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _git(root: Path, *arguments: str) -> str | None:
    """Output of git, or None outside a checkout: another project's repository around the package says nothing."""
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=root, capture_output=True, encoding="utf-8", check=True, timeout=30
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _versions() -> dict[str, str]:
    """Python and the installed versions of the package and what it requires."""
    try:
        lines = [line for line in requires(DISTRIBUTION) or () if "extra ==" not in line]
        required = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in lines]
    except PackageNotFoundError:
        required = []
    found = {"python": platform.python_version()}
    for name in (DISTRIBUTION, *required):
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # of another platform
            continue
    return found


def _processor() -> dict[str, str]:
    try:
        names = re.findall(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    except OSError:
        names = []
    return {"architecture": platform.machine(), "processor": names[0] if names else platform.processor()}
