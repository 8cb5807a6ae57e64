"""The report of a teaching: one HTML file that needs nothing else (docs/teaching.md)."""

from understudy.report.report import page, write

__all__ = ["page", "write"]
