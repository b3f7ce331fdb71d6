"""How many workers fit into memory."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io import limits
from scan2albedo.io.images import SUPPORTED_IMAGES, declared_pixels
from scan2albedo.io.input_hash import files_of_scan

MB = 1 << 20
_KEPT_FREE = 0.1

_CGROUP_FILES = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def worker_mb(
    scans: Iterable[Path],
    size: int,
    running_mb: float = 0.0,
    textures: str | Path | None = None,
    template: int = 0,
) -> float:
    """Return the expected peak of a worker with the largest scan.

    `size` is the geometry images' side, `running_mb` a worker's measured peak, `textures` as in `load_scan`,
    `template` the side of a template's texture, whose colours, normals and marks are kept at once. An idle
    worker has 450 MB; a pixel of a picture takes 160 bytes, a byte of a mesh's file 25, a texel 400.
    """
    largest = 0.0
    for path in scans:
        total = 0.0
        with suppress(OSError, ValueError, Scan2AlbedoError):  # a scan that is missing
            for file in files_of_scan(path, textures):
                pixels = None
                if file.suffix.lower() in SUPPORTED_IMAGES:
                    with file.open("rb") as opened:
                        pixels = declared_pixels(opened.read(MB))  # metadata may stand before the size
                if pixels is not None and 0 < pixels <= limits.PIXELS:
                    total += pixels * 160.0
                else:
                    total += file.stat().st_size * 25.0
        largest = max(largest, total)
    # Of a template's texel: two triples of float32, two marks, and some of the means that fill it.
    texels = size * size * 400.0 + template * template * 30
    return max(450.0 + (texels + largest) / MB, running_mb)


def job_limit(asked: int, worker: float) -> tuple[int, str]:
    """Return how many jobs fit into the available memory with `worker` MB each, and a note if not all do."""
    available = available_mb()
    jobs = max(1, min(asked, int((1 - _KEPT_FREE) * available / worker)))
    need = f"a worker may need {worker / 1024:.1f} GB and {available / 1024:.1f} GB are available"
    return jobs, f"{jobs} of {asked} jobs: {need}" if jobs < asked else ""


def available_mb() -> float:
    """Return the memory that may still be taken, of the machine or of its container."""
    import psutil

    available = float(psutil.virtual_memory().available)
    for limit, used in _CGROUP_FILES:
        with suppress(OSError, ValueError):  # no such container, or no limit ("max")
            available = min(available, int(Path(limit).read_text()) - int(Path(used).read_text()))
    return max(available, 0.0) / MB
