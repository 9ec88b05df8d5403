"""Results: ``metrics.csv``, tables, provenance, comparing; a results folder as an object, `Run`."""

from study.results.compare import Comparison, compare
from study.results.comparisons import Comparisons, compare_all
from study.results.evidence import Evidence, find_evidence, pairs_table
from study.results.metrics_csv import CASE, FAILED, read_metrics
from study.results.run import REFERENCE, Run, against_reference, find_runs, keep_pictures, newest, run_folder
from study.results.shown import typical_and_worst
from study.results.tables import beside_paper, hd_table, paper_hd_table, paper_waypoints, waypoint_summary
from study.results.verdicts import claim_rows, claims_markdown, write_claims

__all__ = [
    "CASE",
    "FAILED",
    "REFERENCE",
    "Comparison",
    "Comparisons",
    "Evidence",
    "Run",
    "against_reference",
    "beside_paper",
    "claim_rows",
    "claims_markdown",
    "compare",
    "compare_all",
    "find_evidence",
    "find_runs",
    "hd_table",
    "keep_pictures",
    "newest",
    "pairs_table",
    "paper_hd_table",
    "paper_waypoints",
    "read_metrics",
    "run_folder",
    "typical_and_worst",
    "waypoint_summary",
    "write_claims",
]
