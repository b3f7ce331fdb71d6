"""Reflectance of heads that Mitsuba rendered under flashes, with the mesh's normals right and wrong.

`heads` are 48 pictures, 8 bits, by direct light and with light between parts of the face: relative RMSE of
the albedo of all known vertices, lips and nostrils included; median of the relative difference; the largest
albedo called identified; 95 % intervals of identified albedos that hold the truth.
`bounce` are pale and dark heads that light themselves, 54 pictures of which some pairs are drawn: intervals
of each channel that hold the truth, and how much bounced light was found. CPU seconds are of the fit alone.
Two to ten minutes a rendering; needs ../shared/data and mitsuba.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec

import numpy as np
from worlds.traced_captures import DISTANCE_MM, MitsubaCapture, Skin, mitsuba_capture

from bench.judging import relative_rmse
from bench.runner import Bench, Case, Timed
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.mesh import edges_with_faces, vertex_normals
from scan2albedo.reflectance import (
    ReflectanceFit,
    ReflectanceFitOptions,
    VertexSamples,
    fit_reflectance,
    sample_vertices,
)

OPTIONS = ReflectanceFitOptions(least_pairs=3, most_albedo=1.0)
RMS_OF_MEDIAN = 1.201
"""Of the angles of tilts that are normally distributed."""
SKINS: dict[str, Skin] = {"pale": (0.69, 0.50, 0.42), "dark": (0.15, 0.10, 0.075)}
PAIRS = (3, 5, 10, 20, 50)


def with_normals_off(capture: MitsubaCapture, angle_deg: float) -> FloatArray:
    """Return vertices moved along their normals at random until normals are off by an angle (RMS).

    It is taken from the median, since a few normals at folds turn by far more.
    """
    noise = np.random.default_rng(0).standard_normal(len(capture.vertices))
    own, size = vertex_normals(capture.vertices, capture.faces), 0.01 * angle_deg
    for _ in range(8):
        moved = capture.vertices + size * noise[:, None] * capture.normals
        cosine = (own * vertex_normals(moved, capture.faces)).sum(1)
        off = np.degrees(np.arccos(np.clip(cosine, -1, 1)))[capture.inner]
        size *= angle_deg / max(RMS_OF_MEDIAN * float(np.median(off)), 1e-9)
    return moved


def smoothed(capture: MitsubaCapture) -> FloatArray:
    """Return vertices after Laplacian smoothing, as a scanner of low resolution gives them."""
    edges, _ = edges_with_faces(capture.faces)
    moved, degree = capture.vertices.copy(), np.bincount(edges.ravel(), minlength=len(capture.vertices))
    for _ in range(6):
        sums = np.zeros_like(moved)
        np.add.at(sums, edges[:, 0], moved[edges[:, 1]])
        np.add.at(sums, edges[:, 1], moved[edges[:, 0]])
        moved += 0.5 * (sums / np.maximum(degree, 1)[:, None] - moved)
    return moved


@dataclass(frozen=True)
class Sampled:
    """A capture as a mesh sees it whose normals are believed; `skin` is its red albedo."""

    capture: MitsubaCapture
    samples: VertexSamples
    skin: float = 1.0

    @classmethod
    def of(cls, capture: MitsubaCapture, vertices: FloatArray, normals: FloatArray | None = None) -> Sampled:
        samples = sample_vertices(
            capture.olat,
            capture.rig,
            vertices,
            capture.faces,
            normals=normals,
            reference_distance_mm=DISTANCE_MM,
        )
        return cls(capture, replace(samples, lobes=capture.strength * samples.lobes))


def require_mitsuba() -> None:
    if find_spec("mitsuba") is None:
        raise FileNotFoundError("mitsuba is not installed")


def head_cases(quick: bool) -> Iterator[Case]:
    require_mitsuba()
    size = {"views": 3, "flashes": 4, "size": 64} if quick else {}
    for bounces in (False,) if quick else (False, True):
        capture = partial(mitsuba_capture, bounces=bounces, **size)
        group = "bounced light" if bounces else "direct light"
        meshes: dict[str, Callable[[MitsubaCapture], Sampled]] = {
            "those rendered": lambda made: Sampled.of(made, made.vertices, made.normals),
            "weighted by area": lambda made: Sampled.of(made, made.vertices),
            "off by 1 degree": lambda made: Sampled.of(made, with_normals_off(made, 1.0)),
            "off by 3 degrees": lambda made: Sampled.of(made, with_normals_off(made, 3.0)),
            "of a smoothed mesh": lambda made: Sampled.of(made, smoothed(made)),
        }
        for name, mesh in meshes.items():
            make = partial(lambda mesh, capture: mesh(capture()), mesh, capture)
            yield Case(f"{name}, {group}", make, group)


def fitted(scene: Sampled, options: ReflectanceFitOptions = OPTIONS, bounce: bool = True) -> Timed:
    samples = scene.samples if bounce else replace(scene.samples, form_factors=None)
    start = time.process_time()
    fit = fit_reflectance(samples, options=options)
    return Timed(fit, time.process_time() - start)


def head_errors(scene: Sampled, fit: ReflectanceFit) -> dict[str, float]:
    capture, known = scene.capture, fit.reflectance.known
    truth = np.concatenate([capture.truth.diffuse_linear, capture.truth.weights], axis=1)
    found, sure = fit.parameters, fit.identified
    inside = (fit.low <= truth) & (truth <= fit.high)
    off = np.abs(found[:, :3] - truth[:, :3]) / truth[:, :3]
    return {
        "albedo %": 100 * relative_rmse(found[known, :3], truth[known, :3]),
        "median %": 100 * float(np.median(off[known])),
        "largest": float(found[:, :3][sure[:, :3]].max()),
        "cover %": 100 * float(inside[:, :3][sure[:, :3]].mean()),
    }


def drawn(head: str, skin: str, bounces: bool, pairs: int, quick: bool) -> Sampled:
    size = {"views": 4, "flashes": 7, "size": 128} if quick else {"flashes": 9, "size": 160, "rays": 64}
    capture = mitsuba_capture(head, bounces=bounces, skin=SKINS[skin], **size)
    whole = Sampled.of(capture, capture.vertices)
    chosen = np.sort(np.random.default_rng(0).permutation(len(capture.view))[:pairs])
    return Sampled(capture, whole.samples.of_pairs(chosen), SKINS[skin][0])


def bounce_cases(quick: bool) -> Iterator[Case]:
    require_mitsuba()
    heads = [(head, skin, True) for head in ("person1", "person2") for skin in SKINS]
    heads = [("person2", "pale", True)] if quick else [*heads, ("person1", "pale", False)]
    for head, skin, bounces in heads:
        for pairs in (24,) if quick else PAIRS:
            group = f"{head} {skin}{'' if bounces else ', none'}"
            yield Case(f"{group}, {pairs} pairs", partial(drawn, head, skin, bounces, pairs, quick), group)


def channels(scene: Sampled, fit: ReflectanceFit) -> dict[str, float]:
    row = {"part": float(fit.bounce_albedo[0]) / scene.skin}
    for k, channel in enumerate("RGB"):
        sure = fit.identified[:, k]
        truth, found = scene.capture.truth.diffuse_linear[sure, k], fit.reflectance.diffuse_linear[sure, k]
        below, above = truth < fit.low[sure, k], truth > fit.high[sure, k]
        row[f"{channel} cover %"] = 100 * float(1 - below.mean() - above.mean())
        row[f"{channel} above %"] = 100 * float(above.mean())
        row[f"{channel} median %"] = 100 * float(np.median(np.abs(found / truth - 1)))
    return row


BENCHES = {
    "heads": Bench(
        head_cases,
        methods={
            "ours": fitted,
            "normals right": partial(fitted, options=replace(OPTIONS, normal_sigma_degrees=0.0)),
        },
        score=head_errors,
        warm=True,
    ),
    "bounce": Bench(
        bounce_cases,
        methods={"ours": fitted, "without bounce": partial(fitted, bounce=False)},
        score=channels,
        warm=True,
        summaries=("least", "mean"),
    ),
}
