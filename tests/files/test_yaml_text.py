"""YAML that would be read otherwise than it looks, or would never end, is one line, at once."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from study.data.manifest import load_manifest
from study.errors import StudyError
from study.files.landmarks import read_landmarks
from study.files.yaml_text import MAX_BYTES, MAX_DEPTH, read_yaml, repeated_keys

PAIRS = [*zip("abcdefghij", "bcdefghijk", strict=True)]
LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{name}: &{name} [{','.join([f'*{before}'] * 10)}]\n" for before, name in PAIRS
)
MERGES = "a: &a {x: 1}\n" + "".join(
    f"{name}: &{name} {{<<: [{','.join([f'*{before}'] * 10)}]}}\n" for before, name in PAIRS
)
CHAIN = "a0: &a0 [1]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 3000))


@pytest.mark.parametrize("reader", [load_manifest, read_landmarks])
@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a: 1\na: 2", r"a \(line 1\): expected the key once"),
        ("m: {116: x, 0x74: y}", "expected the key once"),
        ("a: {<<: {b: 1}, <<: {b: 2}}", "expected the key once"),
        ("a: &a [*a]", "a loop"),
        ("a: &a\n  <<: *a\n  b: 1", r"\(line 2\).*a loop"),
        (LAUGHS, "once its aliases are followed"),
        (MERGES, "once its aliases are followed"),
        (CHAIN, "nested too deep"),
        ("[" * 100_000, "nested too deep"),
        ("".join(" " * i + "a:\n" for i in range(2000)), "nested too deep"),
        ("{[1, 2]: 3}", "unhashable key"),
        ("a: 2001-99-99", "month must be"),
        ("a: " + "9" * 6000, "digits"),
        ("a: *b", "undefined alias"),
        ("a: 1\n---\nb: 2", "single document"),
        ("\0", "control characters"),
        ("!!python/tuple [1]", "tag"),
    ],
    ids=range(17),
)
def test_each_fault_is_one_line_at_once(tmp_path: Path, reader, text: str, told: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(text, encoding="utf-8")
    start = time.monotonic()
    with pytest.raises(StudyError, match=told) as caught:
        reader(path)
    assert time.monotonic() - start < 2
    assert len(str(caught.value)) < 500
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_text_or_too_large_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(StudyError, match="YAML in UTF-8"):
        read_yaml(path)
    path.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(StudyError, match="is this another file"):
        read_yaml(path)


def test_aliases_merges_and_some_depth_are_yaml(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: &a {b: [1, 2]}\nc: {<<: *a, d: *a}\n" + "e: " + "[" * (MAX_DEPTH - 2) + "]" * (MAX_DEPTH - 2))
    content, root = read_yaml(path)
    assert content["c"] == {"b": [1, 2], "d": {"b": [1, 2]}}
    assert repeated_keys(root) == []
    path.write_text("")
    assert read_yaml(path) == (None, None)


def test_many_faults_are_counted_not_listed(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: 1\n" * 5000)
    with pytest.raises(StudyError, match=r"4999 faults: .*; and 4979 more$"):
        read_landmarks(path)
