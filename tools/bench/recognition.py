"""Who is recognised by the texture as scanned, by filters of it, by shape, and by albedos.

One scan of each person is the gallery, the others are probes. `figure_10` repeats figure 10 of Toderici et
al. (real people: texture 83 %, albedos of Oren-Nayar, Lambert, Minnaert and harmonics 93, 89, 89, 89 %) on
synthetic people who are hard to tell apart; `lamps` are 20 of them under white flashes, lamps of their own
colours, and soft coloured light of rooms; `traced` are path-traced people on shapes of ICT-FaceKit, the
gallery in a studio; `own` are yours: S2A_PEOPLE names a CSV file with the columns person, session, scan and
any others that name a condition of a scan, whose first scan of each person is the gallery. The folder that
S2A_RECOGNITION names keeps processed scans (one takes 15 s; all cores work).

"rank 1 %" with its 95 % interval (Clopper and Pearson), equal error rate, right claims accepted where 1 % of
the false ones are, and d': how many standard deviations similarities of one person lie above those of two.
"""

import csv
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from worlds.population import Population, population_scan

import scan2albedo as s2a
from bench.peers.filters import histogram_equalized, multi_scale_retinex
from bench.runner import Bench, Case
from scan2albedo.albedo.estimate import SPHERICAL_HARMONICS
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.color import linear_to_srgb
from scan2albedo.lighting.shading import DIFFUSE_MODELS
from scan2albedo.recognition import (
    Identification,
    Templates,
    albedo_templates,
    cmc_curve,
    fused,
    identify_by_similarity,
    roc_curve,
    shape_templates,
    similarity_matrix,
)
from scan2albedo.recognition.templates import LUMINANCE
from scan2albedo.synthetic import Scanner

BRDFS = (*DIFFUSE_MODELS, SPHERICAL_HARMONICS)
DEFAULT = BRDFS[:1]
FLASHES = Population(scanner=Scanner(picture_size=640, size=64))
ROOM = replace(FLASHES, light="room", lamp_colors=0.3)
CROWDS = {
    "white flashes": FLASHES,
    "coloured lamps": replace(FLASHES, lamp_colors=0.2),
    "room": ROOM,
    "room, more alike": replace(ROOM, individuality=0.35),
}
TRACED_PERSONS = 14


@dataclass(frozen=True)
class ListedScan:
    """A scan, made or loaded when it is wanted; `conditions` are those it was taken under."""

    person: str
    name: str
    scan: Callable[[], s2a.RawScan]
    conditions: Mapping[str, str]

    def processed(self, size: int, brdfs: Sequence[str]) -> Path | str:
        """Return the file of what is compared, made where it is not there; why it cannot be made."""
        path = kept_in() / f"{self.name}-{size}-{'-'.join(brdfs)}.npz"
        if path.is_file():
            return path
        try:
            result = s2a.process(self.scan(), size=size, brdf=brdfs[0], seed=0)
            image = result.geometry_image
            if result.albedo is None or image.texture_linear is None:
                return f"{self.name}: no albedo"
            found = {brdf: s2a.estimate_albedo(image, brdf=brdf, seed=0) for brdf in brdfs[1:]}
        except Scan2AlbedoError as error:
            return f"{self.name}: {error}"
        images = {"texture": image.texture_linear, brdfs[0]: result.albedo.albedo_linear}
        images |= {brdf: estimate.albedo_linear for brdf, estimate in found.items()}
        # Half precision has steps of 0.05 %, below a camera's.
        kept = {
            name: np.where(image.seen[..., None], of, 0).astype(np.float16) for name, of in images.items()
        }
        np.savez_compressed(path, seen=image.seen, normal=image.normal, **kept)
        return path


@cache
def kept_in() -> Path:
    folder = Path(os.environ.get("S2A_RECOGNITION") or tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    return folder


class Compared:
    """Probes and a gallery as templates."""

    def __init__(
        self, probes: Sequence[ListedScan], files: Mapping[str, Path], gallery: Sequence[ListedScan]
    ):
        self.sides = probes, gallery
        self._files = files

    def templates(self, made: Callable[..., Templates], image: Callable[..., FloatArray]) -> list[Templates]:
        """Return those of probes and gallery of an image (H, W) or (H, W, 3) of the arrays of each scan."""
        sets = []
        for scans in self.sides:
            arrays = [dict(np.load(self._files[scan.name])) for scan in scans]
            images = [image(each) for each in arrays]
            masks = [each["seen"] for each in arrays]
            sets.append(made(images, [scan.person for scan in scans], masks=masks))
        return sets

    def identified(self, similarities: FloatArray) -> Identification:
        probes, gallery = ([scan.person for scan in scans] for scans in self.sides)
        return identify_by_similarity(similarities, gallery, probes)


Images = Mapping[str, np.ndarray]


def stored(name: str, images: Images) -> FloatArray:
    return images[name].astype(float)


def red_to_green(name: str, images: Images) -> FloatArray:
    """Return red over green (H, W), which shading under lamps of one colour leaves alone."""
    color = stored(name, images)
    lit = np.maximum(color[..., :2], max(float(color.max()), 1e-12) / 255)
    return lit[..., 0] / lit[..., 1]


def filtered(by: Callable[[FloatArray, BoolArray], FloatArray], images: Images) -> FloatArray:
    return by(stored("texture", images) @ LUMINANCE, images["seen"])


def by_image(image: Callable[[Images], FloatArray], people: Compared) -> Identification:
    return people.identified(similarity_matrix(*people.templates(albedo_templates, image)))


def by_shape(people: Compared, brdf: str | None = None) -> Identification:
    """Identify by the surface's normals, and by the albedo of a reflectance beside them."""
    found = {"shape": similarity_matrix(*people.templates(shape_templates, partial(stored, "normal")))}
    if brdf is None:
        return people.identified(found["shape"])
    found["albedo"] = similarity_matrix(*people.templates(albedo_templates, partial(stored, brdf)))
    return people.identified(fused(found))


def methods(brdfs: Sequence[str]) -> dict[str, Callable[[Compared], Identification]]:
    """Return our methods, the albedo of the first reflectance first."""
    images = {f"albedo, {brdf}": partial(stored, brdf) for brdf in brdfs}
    images["albedo, red over green"] = partial(red_to_green, brdfs[0])
    found = {name: partial(by_image, image) for name, image in images.items()}
    return found | {"shape": by_shape, "shape and albedo": partial(by_shape, brdf=brdfs[0])}


PEERS = {
    name: partial(by_image, image)
    for name, image in {
        "texture": partial(stored, "texture"),
        "texture, sRGB": lambda images: linear_to_srgb(stored("texture", images)),
        "histogram equalisation": partial(filtered, histogram_equalized),
        "multi-scale retinex": partial(filtered, multi_scale_retinex),
        "texture, red over green": partial(red_to_green, "texture"),
    }.items()
}


def figures(people: Compared, found: Identification) -> dict[str, float | str]:
    ranks, claims = cmc_curve(found), roc_curve(found, false_accept_rates=[0.01], resamples=0)
    own, others = found.similarities[found.genuine], found.similarities[~found.genuine]
    spread = np.sqrt(max((own.var() + others.var()) / 2, 1e-12))
    return {
        "rank 1 %": 100 * ranks.rate[0],
        "from %": 100 * ranks.low[0],
        "to %": 100 * ranks.high[0],
        "equal error %": 100 * claims.equal_error_rate,
        "accepted %": 100 * claims.true_accept_rate[0],
        "d'": (own.mean() - others.mean()) / spread,
        "": f"{len(found.persons)} persons, {ranks.probes} probes",
    }


def compared(listed: Iterable[ListedScan], size: int, brdfs: Sequence[str], condition: str = "") -> Compared:
    """Process scans, the first of each person's the gallery, and keep the probes of a condition."""
    scans = list(listed)
    work = [partial(ListedScan.processed, scan, size, brdfs) for scan in scans]
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        done = dict(zip((scan.name for scan in scans), pool.map(called, work), strict=True))
    for reason in (why for why in done.values() if isinstance(why, str)):
        print(f"left out: {reason}")
    files = {name: path for name, path in done.items() if isinstance(path, Path)}
    first: dict[str, ListedScan] = {}
    for scan in scans:
        first.setdefault(scan.person, scan)
    gallery = [scan for scan in first.values() if scan.name in files]
    known = {scan.person for scan in gallery}
    probes = [scan for scan in scans if scan.name in files and scan.person in known and scan not in gallery]
    wanted = [scan for scan in probes if not condition or condition in scan.conditions.values()]
    return Compared(wanted, files, gallery)


def called(work: Callable[[], Path | str]) -> Path | str:
    return work()


def one_of_crowd(crowd: str, seed: int, person: int, session: int) -> s2a.RawScan:
    return population_scan(person, session, seed=seed, population=CROWDS[crowd])[0]


def crowd_of(crowd: str, persons: int, sessions: int, seed: int) -> Iterator[ListedScan]:
    for person in range(persons):
        for session in range(sessions):
            make = partial(one_of_crowd, crowd, seed, person, session)
            name = f"{crowd}-{seed}-{person}-{session}".replace(", ", "-").replace(" ", "-")
            yield ListedScan(f"{person:04d}", name, make, {"session": str(session)})


def figure_10(quick: bool) -> list[Case]:
    people = crowd_of("white flashes", 4 if quick else 60, 2 if quick else 4, 0)
    return [Case("60 people", lambda: compared(people, 128 if quick else 256, BRDFS))]


def lamps(quick: bool) -> Iterator[Case]:
    for crowd in list(CROWDS)[: 1 if quick else None]:
        seed = 0 if crowd == "coloured lamps" else 1
        people = crowd_of(crowd, 4 if quick else 20, 2 if quick else 3, seed)
        yield Case(crowd, lambda people=people: compared(people, 128 if quick else 256, DEFAULT))


def scans_of(manifest: Path) -> list[ListedScan]:
    with manifest.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found = []
    for row in rows:
        person, path = row.pop("person"), manifest.parent / row.pop("scan")
        name = f"{manifest.parent.name}-{person}-{row['session']}-{path.stem}"
        found.append(ListedScan(person, name, partial(s2a.load_scan, path), row))
    return found


def by_condition(manifest: Path) -> Iterator[Case]:
    """Yield all probes of a data set, and those of each value of a condition."""
    scans = scans_of(manifest)
    yield Case("all probes", lambda: compared(scans, 256, DEFAULT), "everybody")
    for name in scans[0].conditions:
        for value in dict.fromkeys(scan.conditions[name] for scan in scans):
            here = partial(compared, scans, 256, DEFAULT, value)
            yield Case(f"{name} {value}", here, f"{name} {value}")


def traced(quick: bool) -> Iterator[Case]:
    from worlds.traced_sessions import build_people

    manifest = kept_in() / "traced" / "people.csv"
    list(build_people(manifest, 3 if quick else TRACED_PERSONS))
    return by_condition(manifest)


def own(quick: bool) -> Iterator[Case]:
    if "S2A_PEOPLE" not in os.environ:
        raise FileNotFoundError("S2A_PEOPLE names no CSV file of people")
    return by_condition(Path(os.environ["S2A_PEOPLE"]))


BENCHES = {
    name: Bench(cases, methods=methods(brdfs), peers=PEERS, score=figures, summaries=("mean",))
    for name, cases, brdfs in (
        ("figure_10", figure_10, BRDFS),
        ("lamps", lamps, DEFAULT),
        ("traced", traced, DEFAULT),
        ("own", own, DEFAULT),
    )
}
