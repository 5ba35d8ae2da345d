"""What a run leaves to be read: report.json, report.html and figures, from the files in its folder."""

from edge_server.report.report import build_report

__all__ = ["build_report"]
