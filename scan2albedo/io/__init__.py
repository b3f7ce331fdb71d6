"""Reading and writing of scans, images, geometry images, records and result folders."""

from scan2albedo.io.load_scan import load_scan

__all__ = ["load_scan"]
