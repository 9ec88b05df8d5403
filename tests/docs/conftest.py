"""Small sample files under the names that the pages use. A part of a page adds its own to `site_files.write_site`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import pytest
from site_files import scene, write_site

from study.ultrasound import SweepErrors


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sample files, and `study` in its ``bin``."""
    folder = tmp_path_factory.mktemp("samples")
    program = folder / "bin" / "study"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m study "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    write_site(folder, scene(2000, 1.5, SweepErrors.none()))
    return folder
