"""The report's files: whole, linked, small, without a network; and what is refused."""

import gzip
import json
import re
from base64 import b64decode
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import nbformat
import numpy as np
import pytest

from study.cli import main
from study.errors import StudyError
from study.files.atomic import sha256_of
from study.report import write_report
from study.report.assets import ASSETS, VENDORED_SHA256, require_vendored
from study.report.scenes import STEP_MM, VERTICES, coarse_surface
from study.results.clouds import CLOUDS, Clouds
from study.results.run import Run
from study.types import Mesh

LOADS = {("script", "src"), ("link", "href"), ("img", "src"), ("iframe", "src"), ("source", "src"), ("image", "href")}
MAX_MB, CASES, CTS = 40, 22 * 23 + 20, 10  # all pairs of the reported data sets, with some to spare


class Page(HTMLParser):
    """What a page loads, links to, names and describes."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.alts: list[str | None] = []
        self.labelled = 0
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = dict(attributes)
        self.loads += [str(found[key]) for kind, key in LOADS if tag == kind and found.get(key)]
        if tag == "a" and found.get("href"):
            self.links.append(str(found["href"]))
        if tag == "img":
            self.alts.append(found.get("alt"))
        if found.get("id"):
            self.ids.append(str(found["id"]))


def script_of(path: Path) -> tuple[str, dict[str, Any]]:
    """Key and content of a file of the 3-D view."""
    found = re.fullmatch(r'study\.take\(("[^"]*"), (\{.*\})\);\n', path.read_text(encoding="utf-8"))
    assert found
    return json.loads(found[1]), json.loads(found[2])


def points_of(content: dict[str, Any], name: str) -> np.ndarray:
    at, raw = content["table"][name], gzip.decompress(b64decode(content["blob"]))
    values = np.frombuffer(raw, dtype=f"<{at['type']}", count=at["n"], offset=at["at"])
    return values.reshape(-1, 3) * at["step"] + at["origin"]


def test_pages_load_nothing_from_a_network_and_their_links_hold(report: Path) -> None:
    pages = {path: Page(path) for path in report.rglob("*.html")}
    assert {path.name for path in pages} == {"index.html", "10_made up.html"}
    for path, page in pages.items():
        for there in (*page.loads, *page.links):
            assert not re.match(r"(https?:)?//", there), f"{path.name}: {there}"
            if there.startswith("data:"):
                continue
            file, _, anchor = unquote(there).partition("#")
            target = path if not file else (path.parent / file).resolve()
            assert target.is_file(), f"{path.name}: {there}"
            if anchor:
                assert anchor in pages[target].ids, f"{path.name}: {there}"
        assert page.alts
        assert all(alt and len(alt) > 10 for alt in page.alts), f"{path.name}: {page.alts}"
        assert len(set(page.ids)) == len(page.ids)
    assert "url(" not in (report / "style.css").read_text(encoding="utf-8")


def test_a_notebook_keeps_its_text_and_loses_what_would_be_loaded(report: Path) -> None:
    text = (report / "notebooks" / "10_made up.html").read_text(encoding="utf-8")
    assert "<script" not in text
    assert "cdn.example" not in text
    assert "&lt;b&gt;not bold&lt;/b&gt; $x$" in text
    assert "The map <var>F<sub>k</sub></var> and <var>N<sub>reg</sub></var>" in text
    assert "$F_k$" in text  # in the code, which is nobody's TeX
    assert "<title>10_made up: What is &lt;seen&gt;?</title>" in text


def test_page_holds_what_was_run(report: Path) -> None:
    text = (report / "index.html").read_text(encoding="utf-8")
    config = json.loads(re.findall(r'id="study-config">(.*?)</script>', text)[0])
    (offered,) = config["datasets"]
    assert [pair["label"] for pair in offered["pairs"]] == ["ct1 to patient", "ct2 to patient"]
    assert [method["name"] for method in offered["methods"]] == ["coarse", "skeleton_graph", "truth"]
    assert "nothing here was measured" in offered["kind"]
    assert "No finding is stated" in text  # of two methods and one data set
    assert "Every patient here is simulated" in text
    order = [text.index(f'id="{name}"') for name in ("finding", "claims", "view", "figures", "tables", "notebooks")]
    assert order == sorted(order)
    assert str(Run(report.parent / "phantom").provenance["code_sha256"]) in text


def test_files_of_the_view_hold_the_runs_places(report: Path) -> None:
    key, ct = script_of(report / "data" / "phantom--ct1.js")
    assert key == "phantom/ct1"
    assert b64decode(ct["nifti"])[:2] == b"\x1f\x8b"
    _, pair = script_of(report / "data" / "phantom--ct1--patient.js")
    assert pair["methods"] == ["coarse", "skeleton_graph", "truth"]
    moved = {name: points_of(pair, f"{k}.warped") for k, name in enumerate(pair["methods"])}
    assert np.abs(moved["coarse"]).max() <= STEP_MM  # the frame is that of the coarse alignment
    assert np.abs(moved["truth"] - points_of(pair, "true")).max() <= 2 * STEP_MM
    clouds = Clouds(report.parent / "phantom" / CLOUDS)["ct1", "patient", "skeleton_graph"]
    whole = clouds["warped"]
    rest = points_of(ct, "source") + moved["skeleton_graph"]
    ordered = np.sort(np.linalg.norm(rest - rest.mean(axis=0), axis=1))
    assert len(rest) == min(VERTICES, len(whole))
    assert ordered[-1] <= np.linalg.norm(whole - whole.mean(axis=0), axis=1).max() + 2  # a rigid motion keeps it
    assert "1.g_us" in pair["table"]
    assert "0.g_us" not in pair["table"]


def test_a_whole_study_stays_small(report: Path) -> None:
    """From what a case costs here a vertex; CTs of real people have at most 1 MB."""
    path = report / "data" / "phantom--ct1--patient.js"
    _, pair = script_of(path)
    case = path.stat().st_size / len(pair["methods"]) * VERTICES / (pair["table"]["true"]["n"] / 3)
    notebooks = sum(path.stat().st_size for path in (ASSETS.parents[3] / "notebooks").glob("*.ipynb"))
    own = sum(path.stat().st_size for path in ASSETS.iterdir() if path.is_file())
    assert notebooks > 1e6
    assert CASES * case + CTS * 1e6 + 1.5 * notebooks + own < MAX_MB * 1e6


def test_what_is_vendored_is_what_was_looked_at(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    require_vendored()
    assert {path.name for path in ASSETS.glob("*.umd.js")} == set(VENDORED_SHA256)
    assert sha256_of(ASSETS / "niivue.umd.js") == VENDORED_SHA256["niivue.umd.js"]
    assert "Copyright (c) 2021, Niivue" in (ASSETS / "niivue.LICENSE.txt").read_text(encoding="utf-8")
    (tmp_path / "niivue.umd.js").write_text("another", encoding="utf-8")
    monkeypatch.setattr("study.report.assets.ASSETS", tmp_path)
    with pytest.raises(StudyError, match=r"expected SHA-256 47b896.*, got"):
        require_vendored()


def test_coarse_surface_is_closed_and_its_vertices_are_rows() -> None:
    angles = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    rings = np.array([[30 * np.cos(a), 12 * np.sin(a), z] for z in range(0, 80, 2) for a in angles])
    k = np.arange(39 * 60)
    right = k - k % 60 + (k + 1) % 60
    faces = np.concatenate([np.column_stack([k, right, k + 60]), np.column_stack([right, right + 60, k + 60])])
    mesh = Mesh(rings, faces, np.zeros(len(rings), dtype=int))
    rows, coarse = coarse_surface(mesh, rings[::3], 200)
    assert len(rows) == 200
    assert (np.diff(rows) > 0).all()
    assert coarse.max() < 200
    corners = rings[::3][rows][coarse]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    fine = rings[faces]
    whole = np.linalg.norm(np.cross(fine[:, 1] - fine[:, 0], fine[:, 2] - fine[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(whole, rel=0.12)


# --- what is refused -------------------------------------------------------------------------------------------------


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert main(["report", "--html", *map(str, arguments)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    lines = [line for line in err.splitlines() if line.startswith("study: ")]
    assert len(lines) == 1
    assert "Traceback" not in err
    return lines[0]


def test_a_missing_run_is_one_line(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (runs / "report" / "index.html").stat().st_mtime_ns
    assert "expected a run of planted at" in refused(capsys, runs, "--dataset", "phantom,planted")
    assert "run `study run --dataset phantom` first" in refused(capsys, tmp_path)
    assert (runs / "report" / "index.html").stat().st_mtime_ns == before
    assert not list(runs.glob(".report*"))


def test_a_run_without_clouds_or_with_others_is_refused(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = tmp_path / "phantom"
    there.mkdir()
    for path in (runs / "phantom").iterdir():
        (there / path.name).write_bytes(path.read_bytes())
    (there / CLOUDS).write_bytes(b"other")
    assert "expected the file that the run wrote" in refused(capsys, tmp_path, "--dataset", "phantom")
    (there / CLOUDS).unlink()
    assert Run(there).condition is None  # such as the committed reference: it is whole without them
    assert "expected the clouds of a run" in refused(capsys, tmp_path, "--dataset", "phantom")
    (there / "timings.csv").write_text("", encoding="utf-8")
    assert "edited timings.csv" in refused(capsys, tmp_path, "--dataset", "phantom")
    assert not (tmp_path / "report").exists()


def test_pages_of_somebody_else_are_not_replaced(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "phantom").symlink_to(runs / "phantom")
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "index.html").write_text("mine", encoding="utf-8")
    with pytest.raises(StudyError, match="pages that `study` did not write"):
        write_report(tmp_path, ["phantom"])
    assert (tmp_path / "report" / "index.html").read_text(encoding="utf-8") == "mine"


def test_a_broken_notebook_is_named(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from study.report.notebooks import notebook_page
    from study.report.page import _template

    (tmp_path / "bad.ipynb").write_text("{", encoding="utf-8")
    with pytest.raises(StudyError, match=r"expected a notebook at .*bad\.ipynb"):
        notebook_page(tmp_path / "bad.ipynb", _template("notebook.html.j2"))
    assert nbformat.current_nbformat >= 4
