"""Recognition by templates: cost of a pair, choices of size and channel, and six people under many lamps.

`cost` compares all pairs of random fields, in compiled blocks and one after the other (NumPy, float64);
"differ" is their largest difference. `slips` identifies synthetic people by their true albedo made worse as
an estimate is: the chart slips by so many pixels, light of so many per cent is left in it, and noise;
"separation" is the distance of the mean similarities, right person and others, over the root of their summed
variances. `lamps` are photographs of six people (../shared/data/yale, free for research only, no number is
learned from them) under 11 to 12 lamps each: rank 1 where the gallery is one photograph a person, all of one
lamp or of random lamps, and a probe one photograph or the mean of three. Albedos are estimated once (4 s
each) and kept in the folder that S2A_RECOGNITION names.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from worlds.files import face_data

from bench.peers.filters import multi_scale_retinex
from bench.recognition import kept_in
from bench.runner import Bench, Case
from scan2albedo import GeometryImage, estimate_albedo
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.recognition import (
    Identification,
    TemplateOptions,
    Templates,
    albedo_templates,
    certainty,
    fused,
    identify,
    roc_curve,
    similarity_matrix,
)
from scan2albedo.recognition.similarity import WINDOW
from scan2albedo.recognition.templates import LUMINANCE
from scan2albedo.synthetic import face

CUES = ("albedo", "texture", "shading")
DRAWS = 60
"""Galleries of random lamps."""


def random_templates(count: int, size: int) -> Templates:
    """Return templates of fields within [0.1, 0.9] whose amplitude falls with frequency."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.fftfreq(size))
    frequency[0, 0] = np.inf
    noise = np.random.default_rng(0).standard_normal((count, size, size))
    fields = np.fft.ifft2(np.fft.fft2(noise) / frequency).real
    low, high = (f(axis=(1, 2), keepdims=True) for f in (fields.min, fields.max))
    return albedo_templates(0.1 + 0.8 * (fields - low) / (high - low), [str(k) for k in range(count)])


def one_by_one(templates: Templates) -> FloatArray:
    each = [templates.select([k]) for k in range(len(templates))]
    return np.block([[similarity_matrix(one, other) for other in each] for one in each])


@cache
def reference(size: int) -> FloatArray:
    return one_by_one(random_templates(64, size))


def cost_cases(quick: bool) -> Iterator[Case]:
    for size in (64,) if quick else (128, 256):
        yield Case(f"64 x 64 of {size} pixels", lambda size=size: random_templates(64, size))


def off_reference(templates: Templates, found: FloatArray) -> dict[str, float]:
    return {"differ": float(np.abs(found - reference(4 * templates.mask.shape[1])).max())}


@dataclass(frozen=True)
class Slipped:
    """Albedos (H, W, 3) of people, the same made worse, and where they are known."""

    albedos: list[FloatArray]
    seen: list[FloatArray]
    masks: list[BoolArray]


def worsened(
    albedo: FloatArray, mask: BoolArray, slip: float, light: float, noise: float, seed: int
) -> FloatArray:
    random = np.random.default_rng(seed)
    side = len(albedo)

    def smooth(width: float, deviation: float) -> FloatArray:
        field = gaussian_filter(random.standard_normal((side, side)), width * side, mode="wrap")
        return deviation * field / field.std()

    places = np.mgrid[:side, :side] + np.stack([smooth(0.1, slip), smooth(0.1, slip)])
    filled = np.where(mask[..., None], albedo, albedo[mask].mean(axis=0))
    moved = [map_coordinates(filled[..., k], places, order=1, mode="nearest") for k in range(3)]
    lit = np.stack(moved, axis=2) * np.exp(smooth(0.15, light))[..., None]
    return lit + noise * random.standard_normal(lit.shape)


def slipped(count: int, amounts: Sequence[float]) -> Slipped:
    scenes = [face(k, size=256) for k in range(count)]
    masks = [scene.image.mask for scene in scenes]
    albedos = [scene.albedo_linear.astype(float) for scene in scenes]
    seen = [worsened(a, m, *amounts, k) for k, (a, m) in enumerate(zip(albedos, masks, strict=True))]
    return Slipped(albedos, seen, masks)


def slip_cases(quick: bool) -> Iterator[Case]:
    for amounts in ((1, 0.15, 0.02), (2, 0.25, 0.04), (3, 0.3, 0.06)):
        name = "slip {} px, light {:.0%}, noise {:.0%}".format(*amounts)
        yield Case(name, lambda amounts=amounts: slipped(4 if quick else 24, amounts))


def by_size(size: int, brightest: bool, people: Slipped) -> Identification:
    names = [str(k) for k in range(len(people.masks))]
    sets = []
    for images in (people.albedos, people.seen):
        shown = [image.max(2) if brightest else image @ LUMINANCE for image in images]
        sets.append(albedo_templates(shown, names, masks=people.masks, options=TemplateOptions(size=size)))
    return identify(*sets)


def separated(people: Slipped, found: Identification) -> dict[str, float]:
    own, others = found.similarities[found.genuine], found.similarities[~found.genuine]
    return {
        "rank 1 %": 100 * found.rate(),
        "equal error %": 100 * roc_curve(found, resamples=0).equal_error_rate,
        "separation": (own.mean() - others.mean()) / np.hypot(own.std(), others.std()),
    }


def robust_harmonics(normals: FloatArray, values: FloatArray) -> FloatArray:
    """Return the light (N,) of nine harmonics fitted to values (N,), with Cauchy weights."""
    x, y, z = normals.T
    base = np.stack([0 * x + 1, x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], -1)
    weight = np.ones(len(values))
    for _ in range(40):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(base * root[:, None], values * root, rcond=None)[0]
        left = values - base @ found
        weight = 1 / (1 + (left / (1.5 * 1.4826 * np.median(abs(left)) + 1e-9)) ** 2)
    return np.maximum(base @ found, 0.03 * np.median(base @ found))


@dataclass(frozen=True)
class Photograph:
    """A person in the light of one lamp: what is compared (H, W) by name, and how surely it is known."""

    person: str
    lamp: str
    images: dict[str, FloatArray]
    mask: BoolArray
    certainty: FloatArray


@cache
def photographs(quick: bool) -> list[Photograph]:
    found = []
    for file in sorted(face_data("yale/yaleB11.npz").parent.glob("*.npz"))[: 2 if quick else None]:
        with np.load(file) as stored:
            data = dict(stored)
        normal, mask = data["normal"].astype(float), data["mask"]
        for k, lamp in enumerate(data["lights"][: 3 if quick else None]):
            texture = np.where(mask, data["texture_linear8"][k] / 255.0, 0)
            kept = kept_in() / f"{file.stem}_{k}.npz"
            if not kept.is_file():
                colour = np.repeat(texture[..., None], 3, -1).astype(np.float32)
                image = GeometryImage(data["position_mm"].astype(float), normal, mask, texture_linear=colour)
                made = estimate_albedo(image, seed=0)
                error = np.asarray(made.expected_error)
                np.savez_compressed(kept, albedo=made.albedo_linear.max(-1), expected_error=error)
            with np.load(kept) as stored:
                albedo, error = stored["albedo"].astype(float), stored["expected_error"].astype(float)
            images = {"texture": texture, "albedo": albedo, "retinex": multi_scale_retinex(texture, mask)}
            images["shading"] = np.divide(texture, albedo, out=np.zeros(mask.shape), where=albedo > 0)
            images["harmonics"] = np.zeros(mask.shape)
            images["harmonics"][mask] = texture[mask] / robust_harmonics(normal[mask], texture[mask])
            found.append(Photograph(file.stem, str(lamp), images, mask, certainty(albedo, error, mask)))
    return found


@dataclass(frozen=True)
class Trials:
    """Photographs, and galleries (G,) of them with the groups of probes that are one probe each."""

    photographs: list[Photograph]
    galleries: list[tuple[np.ndarray, list[np.ndarray]]]


def trials(quick: bool, one_lamp: bool, together: int) -> Trials:
    rows = photographs(quick)
    who, lamp = np.array([row.person for row in rows]), np.array([row.lamp for row in rows])
    galleries = [np.flatnonzero(lamp == one) for one in sorted(set(lamp))]
    galleries = [gallery for gallery in galleries if len(gallery) > 1]
    of_one_lamp = len(galleries)
    random = np.random.default_rng(0)
    for _ in range(DRAWS):
        galleries.append(np.array([random.choice(np.flatnonzero(who == one)) for one in sorted(set(who))]))
    found = []
    for gallery in galleries:
        probes = np.flatnonzero(np.isin(who, who[gallery]) & ~np.isin(np.arange(len(who)), gallery))
        order = random.permutation(len(probes)) if together > 1 else np.arange(len(probes))
        of_person = [probes[order][who[probes[order]] == one] for one in sorted(set(who[probes]))]
        groups = [one[k : k + together] for one in of_person for k in range(0, len(one), together)]
        found.append((gallery, groups))
    return Trials(rows, found[:of_one_lamp] if one_lamp else found[of_one_lamp:])


def lamp_cases(quick: bool) -> Iterator[Case]:
    for together in (1, 3):
        for one_lamp in (True, False):
            name = f"gallery in {'one lamp' if one_lamp else 'random lamps'}, probes of {together}"
            yield Case(name, partial(trials, quick, one_lamp, together))


def alike(name: str, scene: Trials, size: int = 256, window: int = WINDOW) -> FloatArray:
    """Return similarities (N, N) of all photographs by one of their images."""
    rows = scene.photographs
    options = TemplateOptions(size=size, unit_mean=name != "retinex")  # retinex is logarithmic already
    masks = [row.certainty if name in CUES else row.mask for row in rows]
    names = [row.person for row in rows]
    made = albedo_templates([row.images[name] for row in rows], names, masks=masks, options=options)
    return similarity_matrix(made, made, window=window)


def recognised(scene: Trials, answer: FloatArray | dict[str, FloatArray]) -> dict[str, float]:
    """Return rank 1 by similarities (N, N), or by those of several cues fused for each gallery."""
    who = np.array([row.person for row in scene.photographs])
    right = []
    for gallery, groups in scene.galleries:
        probes = np.concatenate(groups)
        if isinstance(answer, dict):
            scores = fused({name: values[np.ix_(probes, gallery)] for name, values in answer.items()})
        else:
            scores = answer[np.ix_(probes, gallery)]
        ends = np.cumsum([len(group) for group in groups])[:-1]
        best = [part.mean(0).argmax() for part in np.split(scores, ends)]
        right += list(who[gallery[best]] == who[[group[0] for group in groups]])
    return {"rank 1 %": 100 * float(np.mean(right))}


BENCHES = {
    "cost": Bench(
        cost_cases,
        methods={"in blocks": lambda templates: similarity_matrix(templates, templates)},
        peers={"one by one": one_by_one},
        score=off_reference,
        warm=True,
    ),
    "slips": Bench(
        slip_cases,
        methods={
            f"{size} texels, {'brightest' if brightest else 'luminance'}": partial(by_size, size, brightest)
            for size in (256, 128, 64)
            for brightest in (False, True)
        },
        score=separated,
    ),
    "lamps": Bench(
        lamp_cases,
        methods={
            "fused": lambda scene: {name: alike(name, scene) for name in CUES},
            "albedo": partial(alike, "albedo"),
            **{
                f"albedo, {size} texels, window {window}": partial(alike, "albedo", size=size, window=window)
                for size in (128, 256)
                for window in (3, 7)
            },
        },
        peers={name: partial(alike, name) for name in ("texture", "harmonics", "retinex")},
        score=recognised,
        slow=[f"albedo, {size} texels, window {window}" for size in (128, 256) for window in (3, 7)],
    ),
}
