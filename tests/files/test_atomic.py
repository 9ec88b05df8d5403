"""A file is there whole or not at all."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from study.files.atomic import digest_of, filling, json_text, replacing, sha256_of, write_bytes, write_json, write_text


@pytest.mark.parametrize("alone", [True, False])
def test_a_block_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path, alone: bool) -> None:
    path = tmp_path / "scan.nii.gz"
    write_text(path, "old")

    def fail() -> None:
        with replacing(path, alone=alone) as temporary:
            assert temporary.parent == path.parent
            assert temporary.name.endswith(".nii.gz")  # writers choose a format by it
            temporary.write_text("ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_run_left_is_overwritten_when_no_other_can_be_writing(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with replacing(path, alone=True) as left:
        left.touch()
    left.write_text("left behind, and longer")
    with replacing(path, alone=True) as temporary:
        assert temporary == left
        temporary.write_text("whole")
    assert path.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [path]


def test_missing_folders_are_made_and_bytes_stay_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "c.txt"
    write_text(path, "α\n\r\n")
    assert path.read_bytes() == "α\n\r\n".encode()
    write_bytes(path, b"\x00\xff")
    assert path.read_bytes() == b"\x00\xff"


@dataclass(frozen=True)
class Method:
    rate: float


def test_json_takes_numpy_paths_and_dataclasses_apart_and_refuses_the_rest(tmp_path: Path) -> None:
    content = {"b": np.arange(3), "a": np.float64(0.1), "method": Method(0.5), "where": Path("x") / "y"}
    write_json(content, tmp_path / "a.json")
    text = (tmp_path / "a.json").read_text(encoding="utf-8")
    assert text == json_text(content)
    assert json.loads(text) == {"a": 0.1, "b": [0, 1, 2], "method": {"rate": 0.5}, "where": "x/y"}
    assert text.index('"a"') < text.index('"b"')
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_text({"a": float("nan")})
    with pytest.raises(TypeError, match="cannot write set"):
        json_text({"a": {1}})


def test_the_hash_is_that_of_the_bytes(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"abc")
    assert sha256_of(path) == hashlib.sha256(b"abc").hexdigest()
    assert digest_of(path, "md5") == hashlib.md5(b"abc").hexdigest()


def test_a_folder_is_filled_whole_or_not_at_all(tmp_path: Path) -> None:
    names = ["a.txt", "b.txt", "last.json"]
    with filling(tmp_path / "new" / "out", names, "last.json") as new:
        for name in names:
            (new / name).write_text("1")
    out = tmp_path / "new" / "out"
    (out / "mine.txt").write_text("mine")

    def fail() -> None:
        with filling(out, names, "last.json") as new:
            (new / "a.txt").write_text("2")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert {path.name: path.read_text() for path in out.iterdir()} == {**dict.fromkeys(names, "1"), "mine.txt": "mine"}
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    with filling(out, names, "last.json") as new:
        (new / "last.json").write_text("3")
        (new / "a.txt").write_text("3")
    assert {path.name: path.read_text() for path in out.iterdir()} == {
        "a.txt": "3", "last.json": "3", "mine.txt": "mine"
    }  # fmt: skip


def test_where_filling_is_killed_the_last_file_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_text(tmp_path / "out" / "last.json", "old")
    write_text(tmp_path / "out" / "a.txt", "old")
    replace = Path.replace

    def once(self: Path, target: Path) -> Path:
        if target.name == "b.txt":
            raise KeyboardInterrupt
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", once)

    def write() -> None:
        with filling(tmp_path / "out", ["last.json", "a.txt", "b.txt"], "last.json") as new:
            for name in ("last.json", "a.txt", "b.txt"):
                (new / name).write_text("new")

    with pytest.raises(KeyboardInterrupt):
        write()
    assert {path.name: path.read_text() for path in (tmp_path / "out").iterdir()} == {"a.txt": "new"}
