"""Many scans: processed by local processes or a cluster, resumed, listed in one table."""

from scan2albedo.batch.catalogue import load_albedos, load_catalogue
from scan2albedo.batch.manifest import BatchManifest, ManifestScan, read_manifest
from scan2albedo.batch.records import BatchProgress, BatchReport
from scan2albedo.batch.run import run_batch
from scan2albedo.pipeline.options import ProcessOptions

__all__ = [
    "BatchManifest",
    "BatchProgress",
    "BatchReport",
    "ManifestScan",
    "ProcessOptions",
    "load_albedos",
    "load_catalogue",
    "read_manifest",
    "run_batch",
]
