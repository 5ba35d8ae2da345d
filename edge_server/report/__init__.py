"""The report of a run: report.json, report.html and figures, made from the files in its folder."""
