#!/usr/bin/env bash
# Create the environment: a venv of Python 3.11 or 3.12 with exactly what environment.lock pins.
set -euo pipefail
venv=$1
python=${PYTHON:-}
if [ -z "$python" ]; then
  for candidate in python3.12 python3.11 python3 python; do
    if "$candidate" -c 'import sys, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null; then
      python=$candidate
      break
    fi
  done
fi
if [ -z "$python" ]; then
  echo "setup: expected Python 3.11 or 3.12 on PATH, found neither; install one or run 'make PYTHON=/path/to/python3.12 …'" >&2
  exit 2
fi
"$python" tools/check_system.py
echo "setup: $("$python" --version) in $venv, packages pinned by environment.lock (a few minutes the first time)"
"$python" -m venv --clear "$venv"
"$venv/bin/python" -m pip install -qq --disable-pip-version-check --no-deps --require-hashes -r environment.lock
"$venv/bin/python" -m pip install -qq --disable-pip-version-check --no-deps --no-build-isolation --editable .
