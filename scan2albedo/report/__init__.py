"""Overview pictures of results, and `write_report`: an HTML page about a scan or a batch."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scan2albedo.report.html.write import WrittenReport, write_report

__all__ = ["WrittenReport", "write_report"]


def __getattr__(name: str) -> Any:
    # Overviews are drawn in every run; the page and what it stands on are loaded when it is asked for.
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from scan2albedo.report.html import write

    return getattr(write, name)
