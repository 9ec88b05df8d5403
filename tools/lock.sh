#!/usr/bin/env bash
# Renew environment.lock: every platform and Python the package supports, one version of each package, with hashes.
# Pins that still fit stay, since versions move numbers; `bash tools/lock.sh --upgrade` renews them all.
set -euo pipefail
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
"${PYTHON:-.venv/bin/python}" -m venv "$scratch/uv"
"$scratch/uv/bin/python" -m pip install --quiet --disable-pip-version-check "uv==0.13.9"
# renew LOCK EXTRA MORE...: the file with the extra's pins, and its first lines; uv prefers the pins it finds in its output
renew() {
  local lock=$1 extra=$2
  shift 2
  cp "$lock" "$scratch/lock" 2>/dev/null || cp environment.lock "$scratch/lock"
  "$scratch/uv/bin/uv" pip compile pyproject.toml --extra "$extra" --universal --fork-strategy fewest \
    --python-version 3.11 --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate --no-header --quiet \
    -o "$scratch/lock" "$@"
  {
    echo "# Exact versions with hashes for Python 3.11 and 3.12 on Linux x86-64, Linux arm64 and macOS."
    echo "# Made from pyproject.toml by 'make lock' (uv pip compile --universal --generate-hashes); renew it the same way."
    case $extra in
      dev) echo "# Installed by 'make setup' with pip install --require-hashes --no-deps." ;;
      *) echo "# For clusters: pip install --require-hashes --no-deps -r $lock, then --no-deps the package itself." ;;
    esac
    cat "$scratch/lock"
  } > "$lock.new"
  mv "$lock.new" "$lock"
}
renew environment.lock dev "$@"
# What a worker of `study run --scheduler` needs, at the versions of environment.lock: their numbers must be the same.
renew environment-dask.lock dask -c environment.lock "$@"
