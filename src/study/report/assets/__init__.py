"""What the report's pages are made of: templates, style, the viewer, and NiiVue as its authors published it."""

from __future__ import annotations

from pathlib import Path

from study.errors import StudyError
from study.files.atomic import sha256_of

ASSETS = Path(__file__).parent

# NiiVue 0.69.0, BSD-2-Clause: dist/niivue.umd.js of the npm package @niivue/niivue 0.69.0, whose tarball has
# SHA-1 c097825978aadaf498e9aab9d1f92ebf552eaf37. A plain script, since module scripts do not load from a disk.
VENDORED_SHA256 = {"niivue.umd.js": "47b896b77ec4a5be3ef1949c33ad393b6f45629921f326c279000bcf51bdb4af"}


def require_vendored() -> None:
    """Refuse a copy of somebody else's code that is not the one that was looked at.

    Raises:
        StudyError: that file.
    """
    for name, sha256 in VENDORED_SHA256.items():
        found = sha256_of(ASSETS / name)
        if found != sha256:
            raise StudyError(f"{ASSETS / name}: expected SHA-256 {sha256}, got {found}; install the package again")
