"""Run the quick profile with the newest packages, unlocked, and say which one moves a number.

    python tools/newest.py [--work FOLDER] [--markdown FILE]

A run with the packages of environment.lock is compared with one with the newest versions that pyproject.toml allows.
Where they differ, each numerical package with another version is upgraded alone, from the lock, and compared. Exit
code 0: no number moves; 1: the report says which package moves one; 2: a step failed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
NUMERICAL = (
    "numpy", "scipy", "scikit-learn", "scikit-image", "pandas", "numba", "llvmlite", "open3d-cpu", "open3d", "pycpd",
    "trimesh", "rtree", "simpleitk", "joblib", "threadpoolctl",
)  # fmt: skip
AGREES, DIFFERS = 0, 1
RUN = ("run", "--dataset", "phantom", "--profile", "quick")


class Failed(Exception):
    """A step that did not do what it should; the message says which."""


def changed(locked: Mapping[str, str], newest: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Packages of both with other versions: name to old and new."""
    return {
        name: (locked[name], newest[name])
        for name in sorted({*locked} & {*newest})
        if locked[name] != newest[name] and name != "thoracic-cartilage-study"
    }


def culprits(
    found: Mapping[str, tuple[str, str]], alone: Callable[[str, str], tuple[int, str]]
) -> dict[str, tuple[int, str]]:
    """What each numerical package does alone: the exit code of the comparison and its last words.

    Args:
        found: packages with other versions, see `changed`.
        alone: runs with one package at a version and all others as locked.
    """
    return {name: alone(name, new) for name, (_, new) in found.items() if name in NUMERICAL}


def summary(
    found: Mapping[str, tuple[str, str]], together: tuple[int, str], alone: Mapping[str, tuple[int, str]]
) -> str:
    """The report, Markdown: which package moves a number, then every package with another version."""
    code, told = together
    movers = [name for name, (one, _) in alone.items() if one == DIFFERS]
    broken = [name for name, (one, _) in alone.items() if one not in (AGREES, DIFFERS)]
    if code == AGREES:
        head = "no number moves"
    elif movers:
        head = f"{', '.join(movers)} move{'s' if len(movers) == 1 else ''} a number"
    else:
        head = "numbers move, by no numerical package alone"
    lines = [f"# Newest packages: {head}", ""]
    if broken:
        lines += [f"Could not be tried alone: {', '.join(broken)}.", ""]
    lines += ["| Package | Locked | Newest | Alone |", "|---|---|---|---|"]
    words = {AGREES: "agrees", DIFFERS: "**differs**"}
    lines += [
        f"| {name} | {old} | {new} | {words.get(alone[name][0], 'failed') if name in alone else '–'} |"
        for name, (old, new) in sorted(found.items(), key=lambda item: item[0] not in movers)
    ]
    lines += [f"\n## {name} alone\n\n```\n{alone[name][1]}\n```" for name in movers]
    if code != AGREES:
        lines += [f"\n## All together\n\n```\n{told}\n```"]
    return "\n".join(lines) + "\n"


def step(*command: str | Path, allowed: tuple[int, ...] = (0,)) -> tuple[int, str]:
    """Run a command; its exit code and what it printed.

    Raises:
        Failed: another exit code than the allowed ones.
    """
    told = " ".join(map(str, command))
    print(f"newest: {told}", file=sys.stderr, flush=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}
    done = subprocess.run(
        [str(word) for word in command], cwd=ROOT, env=environment, capture_output=True, encoding="utf-8", check=False
    )
    if done.returncode not in allowed:
        raise Failed(f"{told}: exit code {done.returncode}: {(done.stderr or done.stdout).strip()[-800:]}")
    return done.returncode, done.stdout


class Environment:
    """A virtual environment with the package and its dependencies."""

    def __init__(self, folder: Path) -> None:
        self.bin = folder / "bin"
        step(sys.executable, "-m", "venv", "--clear", folder)
        self.restore()
        self.pip("--no-deps", "--no-build-isolation", "--editable", ".")

    def restore(self) -> None:
        """Every package as environment.lock has it."""
        self.pip("--no-deps", "--require-hashes", "-r", "environment.lock")

    def pip(self, *words: str) -> None:
        """Install."""
        step(self.bin / "python", "-m", "pip", "install", "-qq", "--disable-pip-version-check", *words)

    def versions(self) -> dict[str, str]:
        """Every package, by its lower-case name."""
        _, told = step(self.bin / "python", "-m", "pip", "list", "--format=freeze", "--disable-pip-version-check")
        pairs = (line.partition("==") for line in told.splitlines() if "==" in line)
        return {name.lower().replace("_", "-"): version for name, _, version in pairs}

    def run(self, out: Path) -> Path:
        """The study's numbers with these packages."""
        shutil.rmtree(out, ignore_errors=True)
        step(self.bin / "study", *RUN, "--out", out)
        return out

    def compare(self, reference: Path, out: Path) -> tuple[int, str]:
        """What `study compare` says of a new run."""
        code, told = step(self.bin / "study", "compare", reference, self.run(out), allowed=(AGREES, DIFFERS))
        return code, told.strip()


def work(folder: Path) -> tuple[int, str]:
    """Exit code and report."""
    folder.mkdir(parents=True, exist_ok=True)
    environment = Environment(folder / "venv")
    locked = environment.versions()
    reference = environment.run(folder / "locked")
    environment.pip("--upgrade", "--upgrade-strategy", "eager", "--no-build-isolation", "--editable", ".")
    found = changed(locked, environment.versions())
    together = environment.compare(reference, folder / "newest") if found else (AGREES, "nothing is newer")

    def alone(name: str, version: str) -> tuple[int, str]:
        try:
            environment.restore()
            environment.pip("--upgrade", f"{name}=={version}")  # with what it needs of newer others
            return environment.compare(reference, folder / f"with-{name}")
        except Failed as error:
            return 2, str(error)

    told = culprits(found, alone) if together[0] != AGREES else {}
    return together[0], summary(found, together, told)


def main() -> int:
    """Run, compare, say."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=ROOT / "results" / "trials" / "newest")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    try:
        code, report = work(options.work.resolve())
    except Failed as error:
        code, report = 2, f"# Newest packages: a step failed\n\n```\n{error}\n```\n"
    print(report)
    if options.markdown is not None:
        options.markdown.write_text(report, encoding="utf-8")
    return code


if __name__ == "__main__":
    sys.exit(main())
