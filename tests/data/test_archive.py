from __future__ import annotations

import io
import stat
import zipfile
from pathlib import Path

import pytest
from http_archive import (
    FAST,
    Write,
    make_zip,
)

from study.data.fetch import fetch
from study.errors import StudyError


def test_members_that_leave_the_folder_are_refused(write: Write, folder: Path) -> None:
    for name in ("../x.nii.gz", "/etc/x.nii.gz", "a/../../x.nii.gz", "..\\x/x.nii.gz"):
        manifest = write(make_zip({name: b"evil", "good": b"good"}), "x.nii.gz")
        with pytest.raises(StudyError, match="the archive is not safe"):
            fetch(manifest.file("ct"), web=FAST)
    assert not list(folder.parent.rglob("x.nii.gz"))


def test_links_are_refused(write: Write) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        link = zipfile.ZipInfo("x.nii.gz")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(StudyError, match="link"):
        fetch(write(packed.getvalue(), "x.nii.gz").file("ct"), web=FAST)


@pytest.mark.parametrize(
    ("members", "wanted"),
    [(["b.nii.gz"], "a.nii.gz"), (["s2/ct.nii.gz"], "s1/ct.nii.gz"), (["s1/ct.nii.gz", "s2/ct.nii.gz"], "ct.nii.gz")],
)
def test_a_missing_or_ambiguous_member_is_never_guessed(write: Write, members: list[str], wanted: str) -> None:
    manifest = write(make_zip(dict.fromkeys(members, b"x")), wanted)
    with pytest.raises(StudyError, match=r"expected one member .*, got [02] among"):
        fetch(manifest.file("ct"), web=FAST)
