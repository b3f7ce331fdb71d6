"""`write_report`: processed scans as one HTML page that needs no network."""

from scan2albedo.report.html.write import WrittenReport, write_report

__all__ = ["WrittenReport", "write_report"]
