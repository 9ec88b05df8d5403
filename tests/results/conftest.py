"""A folder with ``metrics.csv``, written from rows."""

import pytest

from study.results.metrics_csv import write_metrics


@pytest.fixture
def run(tmp_path):
    def write(name, rows):
        write_metrics(rows, tmp_path / name / "metrics.csv")
        return tmp_path / name

    return write
