"""Overview pictures of results, and `write_report`: an HTML page about a scan or a batch."""

from typing import TYPE_CHECKING

from scan2albedo.lazy import names_when_asked

if TYPE_CHECKING:
    from scan2albedo.report.html.write import WrittenReport as WrittenReport, write_report as write_report

__getattr__, __dir__, __all__ = names_when_asked(__name__, __file__)
