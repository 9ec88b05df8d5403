import numpy as np
import pytest
from result_rows import some_rows

from study.errors import StudyError
from study.results.metrics_csv import (
    COLUMNS,
    Case,
    metric_rows,
    read_metrics,
    write_metrics,
    write_timings,
)


def test_metrics_keep_every_bit_and_any_row_order_gives_the_same_bytes(tmp_path):
    rows = some_rows(without=[("ct2", "icp")])
    a, b = tmp_path / "a" / "metrics.csv", tmp_path / "b.csv"
    write_metrics(rows, a)
    write_metrics([rows[k] for k in np.random.default_rng(1).permutation(len(rows))], b)
    assert a.read_bytes() == b.read_bytes()
    assert b"\r" not in a.read_bytes()
    table = read_metrics(a)
    assert tuple(table.columns) == COLUMNS
    assert len(table) == len(rows) == 5 * 41 + 1
    written = {tuple(row[name] for name in COLUMNS[:7]): row["value"] for row in rows}
    for row in table.itertuples(index=False):
        expected = written[tuple(row[:7])]
        assert row.value == expected or (np.isnan(expected) and np.isnan(row.value))
    assert not list(tmp_path.rglob("*.tmp"))


def test_a_failed_case_is_one_row_with_its_reason(tmp_path):
    write_metrics(some_rows(without=[("ct2", "icp")]), tmp_path / "metrics.csv")
    table = read_metrics(tmp_path / "metrics.csv")
    failed = table[table["status"].str.startswith("failed")]
    assert len(failed) == 1
    assert failed.iloc[0]["status"] == "failed: no sternum found in 'ct2': best overlap 0.31, need 0.60"
    assert set(table.loc[table["method"] == "icp", "status"]) == {"not converged", failed.iloc[0]["status"]}


def edited(text, old, new):
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda text: "", "expected a table"),
        (lambda text: text.splitlines()[0] + "\n", "only a header"),
        (lambda text: edited(text, "subject", "patient"), "expected columns"),
        (lambda text: edited(text, ",hd,0,", ",hd,first,"), "expected numbers"),
        (lambda text: edited(text, ",hd,", ",hausdorff,"), "line 2: expected a known metric"),
        (lambda text: edited(text, ",mm,ok", ",cm,ok"), "expected the metric's unit"),
        (lambda text: edited(text, ",mm,ok", ",mm,fine"), "expected a status"),
        (lambda text: edited(text, ",mm,ok", ",mm,failed: late"), "finite value exactly where"),
        (lambda text: text + text.splitlines()[-1] + "\n", "expected one row per"),
        (lambda text: text + "a,b\n", "expected numbers"),
        (lambda text: text + ",".join("abcdefghijklm") + "\n", "expected a table"),
    ],
)
def test_other_schemas_are_refused_and_located(tmp_path, spoil, message):
    path = tmp_path / "metrics.csv"
    write_metrics(some_rows(), path)
    path.write_text(spoil(path.read_text(encoding="utf-8")))
    with pytest.raises(StudyError, match=message):
        read_metrics(path)


def test_what_cannot_be_read_is_not_written(tmp_path):
    path = tmp_path / "metrics.csv"
    rows = some_rows()
    for bad in ([], [*rows, rows[0]], [*rows[1:], {**rows[0], "value": float("nan")}]):
        with pytest.raises(StudyError):
            write_metrics(bad, path)
    assert not path.exists()
    with pytest.raises(StudyError, match="expected a metric among"):
        metric_rows(Case("d", "s", "t", "m", 0), {"hausdorff": 1.0})
    with pytest.raises(StudyError, match="write a failed row"):
        metric_rows(Case("d", "s", "t", "m", 0), {"hd": np.nan})


def test_timings_are_sorted(tmp_path):
    row = {"dataset": "phantom", "source": "ct1", "target": "patient", "method": "icp", "seed": 0, "seconds": 0.5}
    write_timings([{**row, "stage": "register"}, {**row, "stage": "align"}], tmp_path / "timings.csv")
    lines = (tmp_path / "timings.csv").read_text(encoding="utf-8").splitlines()
    assert [line.split(",")[5] for line in lines] == ["stage", "align", "register"]
