"""What the recognition experiment is run with."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path

from worlds.population import Population

import scan2albedo
from scan2albedo.albedo.estimate import BRDFS
from scan2albedo.core.geometry_image import SMALLEST_SIZE
from scan2albedo.recognition import TemplateOptions
from scan2albedo.recognition.similarity import WINDOW
from scan2albedo.synthetic import Scanner

_PROCESSING = (
    "albedo",
    "core",
    "face_model",
    "fitting",
    "geometry",
    "geometry_image",
    "io",
    "lighting",
    "optimization",
    "pipeline",
    "registration",
    "synthetic",
)
"""Code and data that decide what becomes of a scan."""


@dataclass(frozen=True, kw_only=True)
class RecognitionExperimentOptions:
    """Who is scanned, and how scans are processed and compared.

    Parameters
    ----------
    persons, probes : int
        People, and scans of each beside the one of the gallery.
    size : int
        Height and width of the geometry images.
    seed : int
        Of the population.
    brdfs : tuple of str
        Reflectances whose albedos are compared.
    population : Population
    templates : TemplateOptions
    window : int
        Side of the windows of CW-SSIM.

    Raises
    ------
    ValueError
        When a value is out of range.
    """

    persons: int = 60
    probes: int = 3
    size: int = 256
    seed: int = 0
    brdfs: tuple[str, ...] = BRDFS
    population: Population = field(
        default_factory=lambda: Population(scanner=Scanner(picture_size=640, size=64))
    )
    templates: TemplateOptions = TemplateOptions()
    window: int = WINDOW

    def __post_init__(self) -> None:
        if self.persons < 2 or self.probes < 1:
            raise ValueError(
                f"persons is {self.persons} and probes {self.probes}, expected at least 2 and 1: nobody "
                "can be mistaken otherwise"
            )
        if self.size < SMALLEST_SIZE or self.seed < 0:
            raise ValueError(
                f"size is {self.size} and seed {self.seed}, expected at least {SMALLEST_SIZE} and 0"
            )
        if unknown := sorted(set(self.brdfs) - set(BRDFS)):
            raise ValueError(f"brdfs holds {unknown[0]!r}, expected names from {', '.join(BRDFS)}")
        if not self.brdfs or len(set(self.brdfs)) < len(self.brdfs):
            raise ValueError(f"brdfs is {self.brdfs}, expected one name or more, each once")

    def scans_key(self) -> str:
        """Return a short name of everything that the processed scans depend on, BRDFs apart."""
        made_of = {
            "package": scan2albedo.__version__,
            "code": _code_hash(),
            "size": self.size,
            "seed": self.seed,
            "population": asdict(self.population),
        }
        return hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:16]


@cache
def _code_hash() -> str:
    package, worlds = Path(scan2albedo.__file__).parent, Path(__file__).parents[1] / "worlds"
    digest = hashlib.sha256()
    for file in (worlds / "population.py", worlds / "rooms.py"):
        digest.update(file.name.encode() + file.read_bytes())
    for name in _PROCESSING:
        for file in sorted(f for f in (package / name).rglob("*") if f.suffix in (".py", ".npz", ".json")):
            digest.update(file.relative_to(package).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()
