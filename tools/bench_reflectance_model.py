"""Morphable reflectance: lobes at oblique views, fits to images, shadows, speed.

    python tools/bench_reflectance_model.py [lobes] [fit] [shadows] [photograph] [speed] [unknown]
                                            [--picture fit.png] [--photographs faces.png]
                                            [--cases 16] [--landmarks] [--traced FOLDER]
                                            [--unknown faces.png]

Faces are painted by `scan2albedo.synthetic`, with random lobes, on the default face model's surface. Light
is generated; it casts shadows in `shadows` and `photograph` only, ray-traced as
`worlds.model_faces` tells.
`unknown` shares nothing with the fit: light-stage shapes of ../shared/data, skin painted in space, traced
by Mitsuba (`worlds.unknown_faces`). The model is that of 200 synthetic people, the mesh one fitted
to the shape. Pictures, 25 s each, are kept in the folder that --traced names. "left" is what light and
coefficients, without details, leave of the photograph.
With --landmarks the shape, too, is found from the photograph (68 landmarks, a pixel off): six people from
pale to dark in three lights each; the truth is what the picture shows at a vertex.
Albedo errors are relative RMSE after the best single scale, over seen vertices; faces are such as the model
was not learned from, unless said. Times are CPU seconds.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from functools import cache
from unittest.mock import patch

import numpy as np
from worlds.environments import generated_environment
from worlds.model_faces import CAMERA_MM, ShadowedSurface, albedo_error, learned, person, sent, shot, surface

from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import look_at, project
from scan2albedo.geometry.rasterization import interpolate, rasterize
from scan2albedo.io.images import write_png
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.harmonics import harmonics, project_environment
from scan2albedo.reflectance import (
    EXPONENTS,
    ImageFit,
    ImageObservation,
    LightingModel,
    LightResponse,
    MorphableReflectanceModel,
    VertexReflectance,
    fit_face,
    fit_image,
    light_transfer,
    observe_photograph,
    shade_environment,
)
from scan2albedo.runs.reflectance.model_run import synthetic_model

IMAGE_FIT = "scan2albedo.reflectance.image_fit"


def print_lobes() -> None:
    """Print the error of the highlights against sums over distant lights."""
    toward = distant_directions(20_000)
    angles = (0, 30, 45, 60, 70, 80)
    print(f"{'specular error %':22}" + "".join(f"{a:>8} deg" for a in angles))
    for s_index, exponent in enumerate(EXPONENTS):
        errors = {lobe: np.zeros(len(angles)) for lobe in ("tilted", "full")}
        for k, angle in enumerate(np.radians(angles)):
            off, norm = dict.fromkeys(errors, 0.0), 0.0
            for seed in range(6):
                light = project_environment(generated_environment(seed))
                n, v = np.array([0, 0, 1.0]), np.array([np.sin(angle), 0, np.cos(angle)])
                half = normalized(toward + v)
                lobe = (exponent + 2) / (8 * np.pi) * np.maximum(half @ n, 0) ** exponent * (toward @ n > 0)
                truth = lobe @ (harmonics(toward) @ light) * 4 * np.pi / len(toward)
                only = VertexReflectance(np.zeros((1, 3)), np.eye(3)[[s_index]], np.ones(1, bool))
                norm += np.sum(truth**2)
                for name in errors:
                    made = shade_environment(only, n[None], v[None], light, lobe=name).specular_linear[0]
                    off[name] += np.sum((made - truth) ** 2)
            for name in errors:
                errors[name][k] = np.sqrt(off[name] / norm)
        for name, row in errors.items():
            print(f"s = {exponent:<4g}{name:14}" + "".join(f"{100 * e:12.1f}" for e in row))


def print_fits(picture: str | None) -> None:
    """Print albedo errors of fits by weight of the prior, noise and unmodelled shadow."""
    model = learned(60, 40)
    faces = [person(k) for k in range(8)]
    of_mean = np.mean([albedo_error(model.diffuse.mean, face) for face in faces])
    best = np.mean([albedo_error(model.project(f).reflectance.diffuse_linear, f) for f in faces])
    print(f"mean face {of_mean:.4f}, nearest of the model {best:.4f}")
    print(
        f"{'prior':>8}{'softness':>10}"
        + "".join(f"{c:>22}" for c in ("1 % noise", "5 %", "1 %, shadow on 15 %"))
    )
    for prior, softness in ((1e-3, 0.01), (3e-4, 0.01), (1e-4, 0.01), (3e-5, 0.01), (1e-4, 1.0)):
        row = ""
        for noise, shadow in ((0.01, 0.0), (0.05, 0.0), (0.01, 0.15)):
            start = time.process_time()
            with patch.multiple(IMAGE_FIT, PRIOR_WEIGHT={False: prior}, SOFTNESS=softness):
                fits = [fit_image(shot(face, k, noise, shadow), model) for k, face in enumerate(faces)]
            used = (time.process_time() - start) / len(faces)
            pairs = zip(fits, faces, strict=True)
            error = np.mean([albedo_error(f.face.reflectance.diffuse_linear, face) for f, face in pairs])
            row += f"{error:14.4f} {used:5.2f} s"
        print(f"{prior:8g}{softness:10g}{row}")
    if picture:
        draw(picture, faces[3], shot(faces[3], 3), fit_image(shot(faces[3], 3), model))


@cache
def shadowed_surface() -> ShadowedSurface:
    s, fine = surface(), surface(2)
    return ShadowedSurface(s.vertices, s.normals, s.view, (fine.vertices, fine.faces))


@cache
def transfer() -> LightResponse:
    s = surface()
    return light_transfer(s.vertices, s.faces, s.normals, s.view)


@dataclass(frozen=True)
class ShadowedCases:
    """Faces, the light (V, 4, 3) each receives in its picture and in another, all with shadows."""

    faces: list[VertexReflectance]
    received: np.ndarray
    elsewhere: np.ndarray

    @classmethod
    def of(cls, faces: list[VertexReflectance], seed: int) -> ShadowedCases:
        maps = [generated_environment(seed + k) for k in range(2 * len(faces))]
        received = shadowed_surface().received(maps)
        return cls(faces, received[: len(faces)], received[len(faces) :])

    def picture(self, k: int, with_transfer: bool) -> ImageObservation:
        s, rng = surface(), np.random.default_rng([k, 3])
        color = sent(self.faces[k], self.received[k])
        color = color * (1 + 0.01 * rng.normal(size=color.shape))
        return ImageObservation(color, s.normals, s.view, s.seen, transfer() if with_transfer else None)

    def errors(self, found: list[VertexReflectance]) -> str:
        """Mean and worst albedo error, and error under the other light after the best scale."""
        albedo = [albedo_error(a.diffuse_linear, b) for a, b in zip(found, self.faces, strict=True)]
        relit = []
        for k, reflectance in enumerate(found):
            a, b = (sent(face, self.elsewhere[k])[surface().seen] for face in (reflectance, self.faces[k]))
            relit.append(np.linalg.norm(np.sum(a * b) / np.sum(a * a) * a - b) / np.linalg.norm(b))
        return f"{np.mean(albedo):10.4f}{np.max(albedo):10.4f}{np.mean(relit):10.4f}"

    def fitted(self, with_transfer: bool, prior: float) -> str:
        """Return errors and CPU seconds of fits."""
        model = learned(60, 40)
        LightingModel.default()
        pictures = [self.picture(k, with_transfer) for k in range(len(self.faces))]
        start = time.process_time()
        with patch.multiple(IMAGE_FIT, PRIOR_WEIGHT={with_transfer: prior}):
            fits = [fit_image(picture, model) for picture in pictures]
        used = (time.process_time() - start) / len(fits)
        return f"{self.errors([fit.face.reflectance for fit in fits])}{used:8.2f} s"

    def chosen(self) -> str:
        """Return errors, CPU seconds and how often `fit_face` finds more than the mean face."""
        s, model = surface(), learned(60, 40)
        start = time.process_time()
        found = [fit_face(self.picture(k, True), model, s.vertices, s.faces) for k in range(len(self.faces))]
        used = (time.process_time() - start) / len(found)
        better = sum(one.beats_mean for one in found)
        return f"{self.errors([one.reflectance for one in found])}{used:8.2f} s, not the mean in {better}"


def people_of_the_model(first: int) -> list[VertexReflectance]:
    model = learned(60, 40)
    return [model.project(person(1000 + first + k)).reflectance for k in range(8)]


def print_received_light() -> None:
    """Print errors of what vertices receive, and what the transfer costs."""
    s = surface()
    maps = [generated_environment(60_000 + k) for k in range(20)]
    truth = shadowed_surface().received(maps)[:, s.seen]
    size = np.linalg.norm(truth, axis=(1, 3))
    lights = [project_environment(image) for image in maps]
    shadows = shadowed_surface().received(maps, shadows=False)[:, s.seen]
    print("light received, median relative RMSE, %: diffuse, s = 1, 8, 64")

    def row(name: str, made: np.ndarray, note: str = "") -> None:
        off = np.median(np.linalg.norm(made - truth, axis=(1, 3)) / size, axis=0)
        print(f"{name:30}" + "".join(f"{100 * e:8.2f}" for e in off) + note)

    row("exact, without shadows", shadows)
    start = time.process_time()
    for count in (256, 512, 1024, 2048):
        start = time.process_time()
        made = light_transfer(s.vertices, s.faces, s.normals, s.view, directions=count)
        used = time.process_time() - start
        whole = np.concatenate([made.diffuse[:, None], made.specular], axis=1)[s.seen]
        row(
            f"transfer of {count} directions", np.stack([whole @ light for light in lights]), f"{used:8.2f} s"
        )


def print_shadows() -> None:
    """Print fits to pictures with cast shadows, with and without the transfer."""
    print_received_light()
    model = learned(60, 40)
    mean = model.reconstruct(np.zeros(model.components)).reflectance
    groups = {
        "faces of the model": ShadowedCases.of(people_of_the_model(20), 62_000),
        "new faces": ShadowedCases.of([person(k) for k in range(8)], 63_000),
    }
    print(f"{'':44}{'albedo':>10}{'worst':>10}{'relit':>10}{'fit':>10}")
    for name, cases in groups.items():
        print(f"{name + ', mean face':44}{cases.errors([mean] * 8)}")
        nearest = [model.project(face).reflectance for face in cases.faces]
        print(f"{name + ', nearest of the model':44}{cases.errors(nearest)}")
        for with_transfer in (False, True):
            for prior in (1e-3, 3e-4, 1e-4):
                label = f"{name}, {'with' if with_transfer else 'no'} transfer, prior {prior:g}"
                made = cases.fitted(with_transfer, prior)
                print(f"{label:44}{made}", flush=True)
        print(f"{name + ', what fit_face chooses':44}{cases.chosen()}", flush=True)


def photograph_of(cases: ShadowedCases, k: int, camera: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A picture (H, W, 3) of 8 bits before grey, of gamma 1.2, in which no skin is saturated."""
    s = surface()
    pixels, depth = project(camera, s.vertices)
    raster = rasterize(pixels, -depth, s.faces, shape)
    linear = sent(cases.faces[k], cases.received[k])
    shown = (0.9 * linear / linear[s.seen].max()) ** (1 / 1.2)
    inside = raster.face[..., None] >= 0
    return np.round(255 * np.where(inside, interpolate(raster, s.faces, shown), 0.5)).astype(np.uint8)


def print_photographs(picture: str | None) -> None:
    """Print fits to photographs of 8 bits, from other gammas than theirs too."""
    s, shape = surface(), (640, 640)
    camera = look_at(CAMERA_MM, s.vertices.mean(0), focal_px=2300.0, shape=shape)
    cases = ShadowedCases.of([person(k) for k in range(8)], 63_000)
    photographs = [photograph_of(cases, k, camera, shape) for k in range(len(cases.faces))]
    model = learned(60, 40)
    print(f"{'gamma (theirs is 1.2)':24}{'albedo':>10}{'worst':>10}{'relit':>10}{'observe':>12}")
    for gamma in (1.2, 1.0, 1.8, 2.4):
        start = time.process_time()
        shots = [observe_photograph(p, camera, s.vertices, s.faces, gamma=gamma) for p in photographs]
        used = (time.process_time() - start) / len(shots)
        found = [fit_image(image, model).face.reflectance for image in shots]
        print(f"{gamma:<24g}{cases.errors(found)}{used:10.2f} s", flush=True)
    if picture:
        write_png(picture, np.concatenate(photographs[:4], axis=1))


def draw(path: str, face: VertexReflectance, image: ImageObservation, fit: ImageFit) -> None:
    """Draw image and fit, albedo and its estimate, weights and theirs."""
    s = surface()
    extent = np.ptp(s.vertices[:, :2], axis=0).max()
    pixels = (s.vertices[:, :2] - s.vertices[:, :2].mean(0)) * [1, -1] * 300 / extent + 160
    raster = rasterize(pixels, s.vertices[:, 2], s.faces, (320, 320))
    found = fit.face.reflectance
    scale = np.sum(found.diffuse_linear * face.diffuse_linear) / np.sum(found.diffuse_linear**2)
    exposure = 0.6 / np.quantile(image.observed_linear[s.seen], 0.98)
    top = [exposure * image.observed_linear, face.diffuse_linear, face.weights]
    bottom = [exposure * fit.radiance_linear, scale * found.diffuse_linear, found.weights]
    rows = [
        np.concatenate([interpolate(raster, s.faces, np.nan_to_num(v)) for v in row], axis=1)
        for row in (top, bottom)
    ]
    write_png(path, np.concatenate(rows))


def print_speed() -> None:
    """Print CPU seconds on 3,663 and 14,533 vertices."""
    LightingModel.default()
    for levels in (1, 2):
        people = [person(k, levels) for k in range(40)]
        start = time.process_time()
        model = MorphableReflectanceModel.from_samples(people)
        learn = time.process_time() - start
        image = shot(person(99, levels), 1, levels=levels)
        start = time.process_time()
        fit = fit_image(image, model)
        used = time.process_time() - start
        count = f"{len(model.known)} vertices"
        print(f"{count}: learn 40 faces {learn:.2f} s, fit {used:.2f} s, {fit.iterations} steps")


def print_unknown(count: int, folder: str | None, picture: str | None, landmarks: bool) -> None:
    """Print errors of the mean face, of the fit alone and of `fit_face` on faces nobody here made."""
    from benchmarks.unknown_judged import judged, sheet
    from worlds.unknown_faces import faces_with_landmarks, unknown_faces

    start = time.process_time()
    models = synthetic_model(200)
    print(f"{models.model.components} directions of 200 people in {time.process_time() - start:.0f} s")
    LightingModel.default()
    found = []
    print(
        f"{'albedo, relative RMSE %':44}{'mean face':>10}{'fit':>8}{'chosen':>8}"
        f"{'relit: mean':>12}{'chosen':>8}{'left':>8}"
    )
    for case in faces_with_landmarks() if landmarks else unknown_faces(count):
        one = judged(case, models, folder, landmarks)
        found.append(one)
        print(one, flush=True)
    errors = np.array([(*one.albedo, *one.relit, *one.seconds) for one in found])
    mean = 100 * errors[:, :5].mean(0)
    print(f"{'mean':44}{mean[0]:10.1f}{mean[1]:8.1f}{mean[2]:8.1f}{mean[3]:12.1f}{mean[4]:8.1f}")
    right = [one.fit.beats_mean == (one.albedo[2] < one.albedo[0]) for one in found]
    worse = sum(one.albedo[2] > one.albedo[0] for one in found)
    fit_worse = sum(one.albedo[1] > one.albedo[0] for one in found)
    print(
        f"decisions right: {sum(right)} of {len(found)}; worse than the mean face: {worse} "
        f"(fit alone {fit_worse})"
    )
    gain = 1 - errors[:, 2] / errors[:, 0]
    print(f"gain over the mean face: {100 * gain.mean():.1f} %, least {100 * gain.min():.1f} %")
    print(f"CPU: fit alone {errors[:, 5].mean():.1f} s, chosen {errors[:, 6].mean():.1f} s")
    if picture:
        write_png(picture, sheet(found[:6]))


PARTS = {
    "lobes": print_lobes,
    "shadows": print_shadows,
    "speed": print_speed,
}
ORDER = ("lobes", "fit", "shadows", "photograph", "speed", "unknown")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", default="all", choices=[*ORDER, "all"])
    parser.add_argument("--picture", help="PNG of one fit: image, albedo, weights; truth above, fit below")
    parser.add_argument("--photographs", help="PNG of four photographs")
    parser.add_argument("--cases", type=int, default=16, help="photographs of unknown faces")
    parser.add_argument(
        "--landmarks", action="store_true", help="unknown faces without a mesh: six people, 18"
    )
    parser.add_argument("--traced", help="folder that keeps the traced pictures of unknown faces")
    parser.add_argument("--unknown", help="PNG of the first six unknown faces")
    arguments = parser.parse_args()
    for part in ORDER if "all" in arguments.parts else arguments.parts:
        print(f"\n{part}")
        if part == "fit":
            print_fits(arguments.picture)
        elif part == "photograph":
            print_photographs(arguments.photographs)
        elif part == "unknown":
            print_unknown(arguments.cases, arguments.traced, arguments.unknown, arguments.landmarks)
        else:
            PARTS[part]()


if __name__ == "__main__":
    main()
