from __future__ import annotations

from pathlib import Path

import pytest

from study.results.journal import Journal

BASIS = {"code": "ab", "seed": 0}
FACTS = [{"step": ["ct1", "p", method, "register"], "inputs": {"ct": "12"}} for method in ("icp", "cpd", "coarse")]
PIECES = [{"rows": [{"value": 0.1 + 0.2 * k, "index": k}], "seconds": 1.5} for k in range(3)]


def filled(path: Path) -> None:
    journal = Journal(path, BASIS)
    for facts, piece in zip(FACTS, PIECES, strict=True):
        assert journal.get(facts) is None
        journal.keep(facts, piece)


def test_what_is_kept_is_found_again_to_the_last_bit(tmp_path: Path) -> None:
    filled(tmp_path / "a")
    again = Journal(tmp_path / "a", BASIS)
    assert [again.get(facts) for facts in FACTS] == PIECES


@pytest.mark.parametrize("changed", ["code", "seed", "inputs", "step"])
def test_what_was_made_otherwise_is_not_found(tmp_path: Path, changed: str) -> None:
    filled(tmp_path / "a")
    basis, facts = dict(BASIS), dict(FACTS[0])
    (basis if changed in basis else facts)[changed] = "other"
    again = Journal(tmp_path / "a", basis)
    assert again.get(facts) is None
    again.keep(facts, {"rows": None, "seconds": 0.0})
    assert Journal(tmp_path / "a", BASIS).get(FACTS[0]) == PIECES[0]


def test_of_a_file_cut_anywhere_the_whole_lines_count_and_more_can_follow(tmp_path: Path) -> None:
    path = tmp_path / "a"
    filled(path)
    content = path.read_bytes()
    ends = [k + 1 for k, byte in enumerate(content) if byte == ord("\n")]
    for cut in (*range(0, len(content), 37), *ends, *(end - 1 for end in ends)):
        path.write_bytes(content[:cut])
        n_whole = sum(end <= cut for end in ends)
        journal = Journal(path, BASIS)
        assert [journal.get(facts) for facts in FACTS] == [*PIECES[:n_whole], *[None] * (3 - n_whole)]
        journal.keep(FACTS[2], PIECES[2])
        journal.keep(FACTS[2], PIECES[2])
        assert Journal(path, BASIS).get(FACTS[2]) == PIECES[2]
        assert path.read_bytes().count(b"\n") == min(n_whole + 1, 3)


def test_a_damaged_line_is_not_believed_nor_what_follows(tmp_path: Path) -> None:
    filled(tmp_path / "a")
    content = bytearray((tmp_path / "a").read_bytes())
    second = content.index(b"\n") + 200
    content[second] ^= 1
    (tmp_path / "a").write_bytes(content)
    journal = Journal(tmp_path / "a", BASIS)
    assert [journal.get(facts) for facts in FACTS] == [PIECES[0], None, None]


def test_without_a_file_it_is_kept_for_this_process(tmp_path: Path) -> None:
    journal = Journal(None, BASIS)
    journal.keep(FACTS[0], PIECES[0])
    assert journal.get(FACTS[0]) == PIECES[0]
    with pytest.raises(ValueError, match="JSON"):
        Journal(tmp_path / "a", BASIS).keep(FACTS[0], {"rows": [float("nan")]})
