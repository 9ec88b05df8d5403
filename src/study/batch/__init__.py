"""A whole data set: every pair, every method, in any number of worker processes."""

from study.batch.evidence import open_evidence
from study.batch.runs import chosen_methods, open_run, run_dataset, run_parameters, run_study, why_stale

__all__ = ["chosen_methods", "open_evidence", "open_run", "run_dataset", "run_parameters", "run_study", "why_stale"]
