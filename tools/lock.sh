#!/usr/bin/env bash
# Renew environment.lock and environment-lab.lock: every platform and Python the package supports, one version of each package, with hashes.
# Pins that still fit stay, since versions move numbers; `bash tools/lock.sh --upgrade` renews them all.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
"${PYTHON:-.venv/bin/python}" -m venv "$scratch/uv"
"$scratch/uv/bin/python" -m pip install --quiet --disable-pip-version-check "uv==0.13.9"

compile() {  # LOCK COMMAND WHAT...: one lock file from what uv is to resolve
  local lock=$1 command=$2
  shift 2
  [ ! -f "$lock" ] || cp "$lock" "$scratch/$lock"  # uv prefers the pins it finds in its output file
  "$scratch/uv/bin/uv" pip compile --universal --fork-strategy fewest --python-version 3.11 --generate-hashes \
    --no-emit-index-url --no-emit-find-links --no-annotate --no-header --quiet -o "$scratch/$lock" "$@"
  {
    echo "# Exact versions with hashes for Python 3.11 and 3.12 on Linux x86-64, Linux arm64 and macOS."
    echo "# Made from pyproject.toml by 'make lock' (uv pip compile --universal --generate-hashes); renew it the same way."
    echo "# Installed by '$command' with pip install --require-hashes --no-deps."
    cat "$scratch/$lock"
  } > "$lock.new"
  mv "$lock.new" "$lock"
}

[ "${1:-}" = --lab ] || compile environment.lock "make setup" pyproject.toml --extra dev "$@"
# What a worker of `study run --scheduler` needs, at the versions of environment.lock: their numbers must be the same.
[ "${1:-}" = --lab ] || compile environment-dask.lock "each worker" pyproject.toml --extra dask -c environment.lock "$@"
[ "${1:-}" != --lab ] || shift  # the other half alone
# JupyterLab beside it: whatever both need has the version that is in environment.lock.
compile environment-lab.lock "make lab" --group lab --constraint environment.lock "$@"
