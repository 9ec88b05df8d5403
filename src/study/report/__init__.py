"""`study report --html`: everything to read of a study as one folder of pages that needs no network."""

from study.report.page import write_report

__all__ = ["write_report"]
