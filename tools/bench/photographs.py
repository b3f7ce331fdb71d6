"""Reflectance of a face from one photograph: lobes at oblique views, light with shadows, fits, unknown faces.

`lobes` and `transfer` are compared with sums over thousands of distant lights: relative RMSE of highlights,
and of what vertices receive (diffuse and lobes of s = 1, 8, 64, medians). `shadows` are painted people of
the face model in generated light with ray-traced shadows: eight of the model that the fit has, eight new
ones.
`unknown` shares nothing with the fit: light-stage shapes, skin painted in space, traced by Mitsuba (25 s
each, kept in the folder that S2A_TRACED names), on a mesh fitted to the shape, and with a shape from 68
landmarks that are a pixel off (six people in three lights, where the truth is what the picture shows at a
vertex). Errors of albedos and of the face relit are relative RMSE after the best single scale; "left" is
what light and coefficients leave of the photograph.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from worlds import unknown_faces as unknown
from worlds.environments import generated_environment
from worlds.model_faces import (
    ShadowedSurface,
    albedo_error,
    learned,
    person,
    scaled_error,
    sent,
    surface,
)

from bench.runner import Bench, Case
from scan2albedo.albedo import albedo_error as error_of
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import project
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import (
    EXPONENTS,
    FaceFit,
    ImageFit,
    ImageObservation,
    LightResponse,
    MorphableReflectanceModel,
    PhotographFiles,
    VertexReflectance,
    fit_face,
    fit_image,
    light_transfer,
    observe_photograph,
    shade_environment,
)
from scan2albedo.reflectance.capture_files import FacePhotographFile
from scan2albedo.runs.reflectance.image_run import LANDMARK_NORMALS, shaped_vertices
from scan2albedo.runs.reflectance.model_run import FaceModels, synthetic_model

ANGLES_DEG = (0, 30, 45, 60, 70, 80)


@dataclass(frozen=True)
class ObliqueLobe:
    """One lobe seen at an angle, and the highlights (L, 3) that L lights send."""

    exponent: float
    view: FloatArray
    lights: list[FloatArray]
    truth: FloatArray

    @classmethod
    def of(cls, exponent: float, angle_deg: float) -> ObliqueLobe:
        toward, angle = distant_directions(20_000), np.radians(angle_deg)
        view = np.array([np.sin(angle), 0, np.cos(angle)])
        n_h = np.maximum(normalized(toward + view)[:, 2], 0)
        lobe = (exponent + 2) / (8 * np.pi) * n_h**exponent * (toward[:, 2] > 0)
        lights = [project_environment(generated_environment(seed)) for seed in range(6)]
        sums = [lobe @ (harmonics(toward) @ light) * 4 * np.pi / len(toward) for light in lights]
        return cls(exponent, view, lights, np.array(sums))

    def shaded(self, lobe: str) -> FloatArray:
        weights = (np.array(EXPONENTS) == self.exponent).astype(float)[None]
        only = VertexReflectance(np.zeros((1, 3)), weights, np.ones(1, bool))
        seen = only, np.array([[0.0, 0.0, 1.0]]), self.view[None]
        shadings = [shade_environment(*seen, light, lobe=lobe) for light in self.lights]
        return np.array([shading.specular_linear[0] for shading in shadings])


def lobe_cases(quick: bool) -> Iterator[Case]:
    for exponent in EXPONENTS:
        for angle in ANGLES_DEG[:: 3 if quick else 1]:
            make = partial(ObliqueLobe.of, exponent, angle)
            yield Case(f"s = {exponent:g} at {angle} deg", make, f"s = {exponent:g}")


@cache
def shadowed_surface() -> ShadowedSurface:
    s, fine = surface(), surface(2)
    return ShadowedSurface(s.vertices, s.normals, s.view, (fine.vertices, fine.faces))


def transfer(directions: int = 1024) -> LightResponse:
    s = surface()
    return light_transfer(s.vertices, s.faces, s.normals, s.view, directions=directions)


def received_by(directions: int, maps: Sequence[FloatArray]) -> FloatArray:
    made = transfer(directions)
    whole = np.concatenate([made.diffuse[:, None], made.specular], axis=1)[surface().seen]
    return np.stack([whole @ project_environment(image) for image in maps])


def received_errors(maps: Sequence[FloatArray], made: FloatArray) -> dict[str, float]:
    truth = shadowed_surface().received(maps)[:, surface().seen]
    off = np.linalg.norm(made - truth, axis=(1, 3)) / np.linalg.norm(truth, axis=(1, 3))
    return dict(
        zip(("diffuse %", "s = 1 %", "s = 8 %", "s = 64 %"), 100 * np.median(off, axis=0), strict=True)
    )


@dataclass(frozen=True)
class Shot:
    """A face, its picture without the transfer, and what it receives in other light."""

    face: VertexReflectance
    image: ImageObservation
    elsewhere: FloatArray

    def errors(self, found: VertexReflectance) -> dict[str, float]:
        relit = (sent(one, self.elsewhere)[surface().seen] for one in (found, self.face))
        return {
            "albedo %": 100 * albedo_error(found.diffuse_linear, self.face),
            "relit %": 100 * scaled_error(*relit),
        }


@cache
def light_of(seed: int) -> FloatArray:
    """Return what eight faces receive in their pictures, and elsewhere (16, V, 4, 3)."""
    return shadowed_surface().received([generated_environment(seed + k) for k in range(16)])


def shadowed(face: VertexReflectance, k: int, seed: int) -> Shot:
    s, rng = surface(), np.random.default_rng([k, 3])
    color = sent(face, light_of(seed)[k])
    color = color * (1 + 0.01 * rng.normal(size=color.shape))
    return Shot(face, ImageObservation(color, s.normals, s.view, s.seen), light_of(seed)[8 + k])


def of_the_model(k: int) -> VertexReflectance:
    return people().project(person(1020 + k)).reflectance


def people() -> MorphableReflectanceModel:
    return learned(60, 40)


def shadow_cases(quick: bool) -> Iterator[Case]:
    for group, face, seed in (("faces of the model", of_the_model, 62_000), ("new faces", person, 63_000)):
        for k in range(2 if quick else 8):
            yield Case(f"{group} {k}", lambda k=k, f=face, s=seed: shadowed(f(k), k, s), group)


@cache
def shared_transfer() -> LightResponse:
    return transfer()


def with_transfer(scene: Shot) -> ImageObservation:
    return replace(scene.image, transfer=shared_transfer())


def mean_face(scene: Shot) -> VertexReflectance:
    return people().reconstruct(np.zeros(people().components)).reflectance


def one_fit(scene: Shot) -> VertexReflectance:
    return fit_image(with_transfer(scene), people()).face.reflectance


def without_transfer(scene: Shot) -> VertexReflectance:
    return fit_image(scene.image, people()).face.reflectance


def chosen(scene: Shot) -> VertexReflectance:
    s = surface()
    return fit_face(with_transfer(scene), people(), s.vertices, s.faces).reflectance


@cache
def models() -> FaceModels:
    return synthetic_model(200)


class Unknown:
    """A photograph of an unknown face, with what the fits see of it and how far its normals may be off."""

    def __init__(self, face: unknown.UnknownFace, landmarks: bool) -> None:
        self.model = models().model
        mean, folder = self.model.diffuse.mean, os.environ.get("S2A_TRACED")
        taken = unknown.photographed(face, mean, None if folder is None else Path(folder))
        self.normal_error = 0.0
        if landmarks:
            content = {"image": "-", "camera": taken.camera.tolist(), "landmarks": [None] * 68}
            given = FacePhotographFile.model_validate(content)
            marks = unknown.landmarks_of(face)
            files = PhotographFiles(
                Path("-"), given, taken.image, taken.skin, taken.camera, None, None, marks
            )
            vertices, _, _ = shaped_vertices(files, models())
            self.normal_error = LANDMARK_NORMALS
            truth = unknown.seen_albedo(face, mean, vertices)
            taken = replace(taken, vertices=vertices, faces=models().mean.faces, albedo=truth)
        self.taken = taken
        self.image = observe_photograph(
            taken.image, taken.camera, taken.vertices, taken.faces, mask=taken.skin
        )
        self.counted = np.asarray(self.image.seen) & self.model.known & np.isfinite(taken.albedo[:, 0])

    def relit(self) -> FloatArray:
        """Return colours (V, 3) of vertices in the picture in other light."""
        pixels, _ = project(self.taken.camera, self.taken.vertices)
        smooth = gaussian_filter(self.taken.relit, (unknown.BLUR_PX, unknown.BLUR_PX, 0))
        rows = [map_coordinates(smooth[..., c], pixels.T[::-1], order=1, mode="nearest") for c in range(3)]
        return np.stack(rows, axis=1)


def unknown_cases(quick: bool) -> Iterator[Case]:
    for group, faces in (("mesh", unknown.unknown_faces(16)), ("landmarks", unknown.faces_with_landmarks())):
        for face in faces[: 1 if quick else None]:
            make = partial(Unknown, face, group == "landmarks")
            yield Case(f"{face.name} {group}", make, group)


def chosen_of(scene: Unknown) -> FaceFit:
    taken = scene.taken
    return fit_face(scene.image, scene.model, taken.vertices, taken.faces, normal_error=scene.normal_error)


def unknown_errors(scene: Unknown, found: VertexReflectance | ImageFit | FaceFit) -> dict[str, float | str]:
    row: dict[str, float | str] = {}
    if isinstance(found, FaceFit):
        steps = [step.stage.rpartition(".")[2] for step in found.plan if step.ran]
        row = {"left %": 100 * found.fit.relative_rmse, "": ", ".join(steps) or "mean face"}
        found = found.reflectance
    elif isinstance(found, ImageFit):
        found = found.face.reflectance
    made = scene.image.transfer.shade(found, scene.taken.relit_light).radiance_linear
    albedo = error_of(found.diffuse_linear, scene.taken.albedo, scene.counted)
    relit = error_of(made, scene.relit(), scene.counted)
    return {"albedo %": 100 * albedo.relative_rmse, "relit %": 100 * relit.relative_rmse} | row


SHADOW_FITS: dict[str, Callable[[Shot], VertexReflectance]] = {
    "one fit": one_fit,
    "fit_face": chosen,
    "no transfer": without_transfer,
    "mean face": mean_face,
    "nearest of the model": lambda scene: people().project(scene.face).reflectance,
}
BENCHES = {
    "lobes": Bench(
        lobe_cases,
        methods={lobe: partial(lambda name, scene: scene.shaded(name), lobe) for lobe in ("tilted", "full")},
        score=lambda scene, made: {
            "RMSE %": 100 * np.linalg.norm(made - scene.truth) / np.linalg.norm(scene.truth)
        },
    ),
    "transfer": Bench(
        lambda quick: [
            Case("20 places", lambda: [generated_environment(60_000 + k) for k in range(2 if quick else 20)])
        ],
        methods={f"{count} directions": partial(received_by, count) for count in (1024, 256, 512, 2048)},
        peers={
            "no shadows": lambda maps: shadowed_surface().received(maps, shadows=False)[:, surface().seen]
        },
        score=received_errors,
    ),
    "shadows": Bench(
        shadow_cases,
        methods=SHADOW_FITS,
        score=Shot.errors,
    ),
    "unknown": Bench(
        unknown_cases,
        methods={
            "fit_face": chosen_of,
            "one fit": lambda scene: fit_image(scene.image, scene.model),
            "mean face": lambda scene: scene.model.reconstruct(np.zeros(scene.model.components)).reflectance,
        },
        score=unknown_errors,
    ),
}
