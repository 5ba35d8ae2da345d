"""The report of a run: report.json, report.html and figures, made from the files in its folder."""

from edge_server.report.report import build_report

__all__ = ["build_report"]
