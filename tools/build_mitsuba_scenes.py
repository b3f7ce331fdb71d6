"""Bake the path-traced test set of the albedo stage: Mitsuba's BSDFs, emitters, shadows and interreflection.

    python tools/build_mitsuba_scenes.py [--check] [--look DIR] [--out DIR] [--threads 1]

Geometry and albedo are the package's; everything about light is Mitsuba's. `--check` bakes Lambert surfaces
without interreflection and compares them with max(0, n.l), embree's shadow rays and the visible part of the
sky instead of writing anything. `--look` writes a contact sheet a geometry.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.mitsuba_bake import Bake, Lamp
from benchmarks.mitsuba_set import (
    ALBEDO_STEP,
    FOLDER,
    NORMAL_STEP,
    POSITION_STEP_MM,
    load_scenes,
    load_surface,
)
from numpy.typing import NDArray

import scan2albedo as s2a
from scan2albedo.core.arrays import FloatArray
from scan2albedo.geometry.rays import RayCaster
from scan2albedo.io.color import linear_to_srgb
from scan2albedo.synthetic import face, hemisphere, light_at, with_normal_error
from scan2albedo.synthetic.renderer import auto_exposure, photograph

SIZE = 128
DEPTH = 6
PATHS = 512
NOISE = 0.004
"""Standard deviation on the linear picture, white = 1."""
FACE_SEED, PERSON_SEED = 0, 4
TILT_DEG = 3.0
"""Root mean square of the wrong normals' error."""

BSDFS: dict[str, tuple[dict[str, Any], str]] = {
    "diffuse": ({"type": "diffuse"}, "reflectance"),
    # Disney's: a retro-reflecting diffuse part under a GGX coat.
    "principled": ({"type": "principled", "roughness": 0.4, "specular": 0.5}, "base_color"),
    # Skin's oily film: refractive index 1.4, and facets as rough as measured on cheeks and foreheads.
    "roughplastic": ({"type": "roughplastic", "int_ior": 1.4, "alpha": 0.3}, "diffuse_reflectance"),
}
"""Mitsuba's BSDFs with the parameter that takes the albedo."""

TEXTURES = {
    "hemisphere": {"wood": 1.0, "wood-coarse": 2.5, "skin": 1.0, "skin-coarse": 2.5, "plain": 1.0},
    "face": {"wood": 1.0, "wood-coarse": 2.5, "skin": 1.0, "plain": 1.0},
    "person": {"skin": 1.0},
}
"""Geometry, texture and its grain."""


@dataclass(frozen=True)
class Recipe:
    """One scene of the set; `clipped` is the part of the texels that the exposure burns out."""

    name: str
    group: str
    geometry: str
    texture: str
    lamps: tuple[Lamp, ...]
    bsdf: str = "diffuse"
    normals: str = "true"
    clipped: float = 0.0
    emitters: tuple[Lamp | None, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "emitters", (None, *self.lamps))


def recipes() -> Iterator[Recipe]:
    """Yield the set's scenes."""
    for texture in ("wood", "wood-coarse", "skin", "plain"):
        for azimuth in (0, 30, 60) if texture.startswith("wood") else (30,):
            name = f"hemisphere-{texture}-distant-{azimuth}"
            yield Recipe(name, "hemisphere distant", "hemisphere", texture, (Lamp(light_at(azimuth)),))
    for texture in ("wood", "skin"):
        lamp = Lamp(light_at(40, 10, distance_mm=600))
        yield Recipe(f"hemisphere-{texture}-near", "hemisphere near", "hemisphere", texture, (lamp,))
    for texture in ("skin", "skin-coarse"):
        yield Recipe(
            f"hemisphere-{texture}-two-near-gloss",
            "hemisphere two near",
            "hemisphere",
            texture,
            (
                Lamp(light_at(45, 10, distance_mm=700)),
                Lamp(light_at(-40, 5, distance_mm=700, intensity=2.0)),
            ),
            "principled",
        )
    for texture in ("wood", "skin", "wood-coarse", "plain"):
        for azimuth in (0, 30, 60) if texture in ("wood", "skin") else (60,):
            name = f"face-{texture}-distant-{azimuth}"
            yield Recipe(name, "face distant", "face", texture, (Lamp(light_at(azimuth)),))
    two = (Lamp(light_at(50, 10)), Lamp(light_at(-40, 5, intensity=2.0)))
    yield Recipe("face-skin-two-lights", "face two lights", "face", "skin", two)
    for texture in ("wood", "skin"):
        lamp = Lamp(light_at(45, 10))
        name = f"face-{texture}-wrong-normals"
        yield Recipe(name, "face wrong normals", "face", texture, (lamp,), normals="tilted")
    glossy = ("person", "skin")
    for azimuth, radius in ((0, 0.0), (30, 0.0), (60, 80.0)):
        lamp = Lamp(light_at(azimuth, distance_mm=900), radius)
        name = f"person-gloss-flash-{azimuth}{'-soft' if radius else ''}"
        yield Recipe(name, "person flash", *glossy, (lamp,), "roughplastic")
    flashes = tuple(Lamp(light_at(azimuth, 10, distance_mm=900, intensity=2.0)) for azimuth in (45, -45))
    yield Recipe("person-gloss-two-flashes", "person two flashes", *glossy, flashes, "roughplastic")
    yield Recipe(
        "person-gloss-over-exposed", "person over-exposed", *glossy, flashes, "roughplastic", clipped=0.03
    )


def synthetic_surface(geometry: str) -> tuple[s2a.GeometryImage, dict[str, NDArray[np.float32]]]:
    """Return a geometry of the package without its fine mesh, and its albedos (H, W, 3) by name."""
    albedos, image = {}, None
    for name, grain in TEXTURES[geometry].items():
        texture = name.split("-")[0]
        if geometry == "hemisphere":
            scene = hemisphere(texture=texture, size=SIZE, grain=grain, bits=None)
        else:
            seed = FACE_SEED if geometry == "face" else PERSON_SEED
            scene = face(seed, texture=texture, size=SIZE, grain=grain, bits=None)
        albedos[name], image = scene.albedo_linear, scene.image
    assert image is not None
    return replace(image, occluder=None, texture_linear=None, specular_scale=None), albedos


def store_surface(geometry: str, folder: Path) -> None:
    """Write a geometry, rounded; the bake reads it back, so that rounding is not an error of the set."""
    image, albedos = synthetic_surface(geometry)
    mask = image.mask
    tilted = with_normal_error(image, TILT_DEG, np.random.default_rng(0)).normal
    normals = {"true": image.normal} | ({"tilted": tilted} if geometry == "face" else {})
    fields: dict[str, NDArray] = {
        "size": np.array(SIZE),
        "mask": np.packbits(mask),
        "position": np.round(image.position[mask] / POSITION_STEP_MM).astype(np.int16),
    }
    fields |= {f"normal_{k}": np.round(n[mask] / NORMAL_STEP).astype(np.int16) for k, n in normals.items()}
    fields |= {f"albedo_{k}": np.round(a[mask] / ALBEDO_STEP).astype(np.uint16) for k, a in albedos.items()}
    if image.region is not None and image.inpaint is not None:
        fields |= {"region": image.region[mask], "inpaint": np.packbits(image.inpaint[mask])}
    np.savez_compressed(folder / f"{geometry}.npz", **fields)


class Studio:
    """Bakes that are shared between scenes: light adds up, so every emitter is rendered apart, once."""

    def __init__(self, folder: Path, threads: int) -> None:
        self._folder, self._threads = folder, threads
        self.bake = cache(self._bake)
        self.radiance = cache(self._radiance)

    def _bake(self, geometry: str, texture: str, bsdf: str) -> Bake:
        surface = load_surface(geometry, self._folder)
        vertices, faces = surface.image.occluder_mesh()
        description, slot = BSDFS[bsdf]
        albedo = surface.albedos[texture]
        bake = Bake(
            vertices,
            surface.normals["true"],
            faces,
            surface.image.mask,
            albedo,
            description,
            slot,
            self._threads,
        )
        if bake.misses:
            raise RuntimeError(f"{geometry}: {bake.misses} texels are seen from nowhere")
        return bake

    def _radiance(self, geometry: str, texture: str, bsdf: str, lamp: Lamp | None) -> FloatArray:
        return self.bake(geometry, texture, bsdf).radiance(lamp, paths=PATHS, depth=DEPTH)

    def photograph(self, recipe: Recipe, seed: int) -> tuple[NDArray[np.uint8], FloatArray]:
        """Return the picture as 8-bit sRGB (N, 3), and V of light and gloss on V of the albedo (N,)."""
        material = (recipe.geometry, recipe.texture, recipe.bsdf)
        radiance = np.sum([self.radiance(*material, lamp) for lamp in recipe.emitters], axis=0)
        gain = auto_exposure(radiance)
        if recipe.clipped:
            gain = 1 / float(np.quantile(radiance.max(1), 1 - recipe.clipped))
        rng = np.random.default_rng([seed, 3])
        picture = photograph(radiance, exposure=gain, noise=NOISE, bits=8, rng=rng)
        albedo = load_surface(recipe.geometry, self._folder).albedos[recipe.texture]
        code = np.round(linear_to_srgb(picture) * 255).astype(np.uint8)
        return code, gain * radiance.max(1) / albedo.max(1)


def build(folder: Path, threads: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for geometry in TEXTURES:
        store_surface(geometry, folder)
    studio, index = Studio(folder, threads), []
    for seed, recipe in enumerate(recipes()):
        code, light = studio.photograph(recipe, seed)
        np.savez_compressed(
            folder / f"{recipe.name}.npz", texture_srgb=code, light_on_value=light.astype(np.float16)
        )
        lights = [
            {
                "azimuth_deg": round(float(np.rad2deg(lamp.light.azimuth_rad)), 6),
                "elevation_deg": round(float(np.rad2deg(lamp.light.elevation_rad)), 6),
                "distance_mm": None if np.isinf(lamp.light.distance_mm) else lamp.light.distance_mm,
                "intensity": lamp.light.intensity,
                "radius_mm": lamp.radius_mm,
            }
            for lamp in recipe.lamps
        ]
        entry = {k: getattr(recipe, k) for k in ("name", "group", "geometry", "texture", "normals", "bsdf")}
        index.append({**entry, "lights": lights})
        burnt = float((code == 255).any(1).mean())
        print(f"{recipe.name:34} V/albedo {light.min():.3f} ... {light.max():.3f}  white {burnt:.2%}")
    (folder / "scenes.json").write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")
    print(f"{sum(path.stat().st_size for path in folder.iterdir()) / 1e6:.2f} MB")


def check(folder: Path, threads: int) -> None:
    """Compare Lambert without interreflection with the closed form and embree's rays."""
    studio = Studio(folder, threads)
    for geometry in TEXTURES:
        surface = load_surface(geometry, folder)
        texture = next(iter(surface.albedos))
        vertices, faces = surface.image.occluder_mesh()
        caster, normals = RayCaster(vertices, faces), surface.normals["true"]
        bake, albedo = studio.bake(geometry, texture, "diffuse"), surface.albedos[texture]
        ways = [(f"distant {a}", Lamp(light_at(a))) for a in (0, 30, 60)]
        ways += [("near 60", Lamp(light_at(60, 10, distance_mm=600))), ("sky", None)]
        for name, lamp in ways:
            seen = bake.radiance(lamp, paths=1024 if lamp is None else 4, depth=2) / albedo
            expected = (
                sky_part(vertices, normals, caster) if lamp is None else lit(vertices, normals, caster, lamp)
            )
            correlation = np.corrcoef(seen[:, 0], expected)[0, 1] if expected.std() > 0.01 else np.nan
            off = np.abs(seen[:, 0] - expected)
            print(
                f"{geometry:12}{name:12} correlation {correlation:.5f}  off by {off.mean():.4f} (mean), "
                f"{np.mean(off > 0.1):.2%} by more than 0.1; channels differ by {np.ptp(seen, 1).max():.1e}"
            )


def lit(vertices: FloatArray, normals: FloatArray, caster: RayCaster, lamp: Lamp) -> FloatArray:
    """Return (N,) E max(0, n.l) times visibility."""
    light = lamp.light
    toward = np.broadcast_to(light.direction, vertices.shape)
    irradiance = np.full(len(vertices), light.intensity)
    if np.isfinite(light.distance_mm):
        toward = light.distance_mm * light.direction - vertices
        reach = np.linalg.norm(toward, axis=1)
        toward, irradiance = toward / reach[:, None], light.intensity * (light.distance_mm / reach) ** 2
    cosine = np.maximum(0, np.einsum("ij,ij->i", normals, toward))
    return irradiance * cosine * ~caster.occluded(vertices + 0.05 * normals, toward)


def sky_part(vertices: FloatArray, normals: FloatArray, caster: RayCaster, rays: int = 2048) -> FloatArray:
    """Return (N,) the cosine-weighted part of the sky that is not hidden."""
    rng, free = np.random.default_rng(0), np.zeros(len(vertices))
    for _ in range(rays):
        direction = rng.normal(size=normals.shape)
        direction = normals + direction / np.linalg.norm(direction, axis=1, keepdims=True)
        free += ~caster.occluded(vertices + 0.05 * normals, direction)
    return free / rays


def look(folder: Path, out: Path) -> None:
    """Write a contact sheet a geometry: picture, albedo, and light on V, side by side for each scene."""
    from PIL import Image

    out.mkdir(parents=True, exist_ok=True)
    sheets: dict[str, list[NDArray]] = {}
    for scene in load_scenes(folder=folder):
        assert scene.image.texture_linear is not None
        light = scene.light_on_value / np.quantile(scene.light_on_value[scene.image.mask], 0.995)
        panels = [scene.image.texture_linear, scene.albedo_linear, np.repeat(light[..., None], 3, 2)]
        row = np.concatenate([linear_to_srgb(np.clip(p, 0, 1)) for p in panels], 1)
        sheets.setdefault(scene.name.split("-")[0], []).append((255 * row).astype(np.uint8))
    for name, rows in sheets.items():
        rows += [np.zeros_like(rows[0])] * (-len(rows) % 3)
        columns = [np.concatenate(rows[c::3], 0) for c in range(3)]
        Image.fromarray(np.concatenate(columns, 1)).save(out / f"{name}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=FOLDER)
    parser.add_argument("--check", action="store_true", help="compare simple bakes of the stored geometry")
    parser.add_argument("--look", type=Path, help="a folder for contact sheets of the stored set")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    if not (arguments.check or arguments.look):
        build(arguments.out, arguments.threads)
    if arguments.check:
        check(arguments.out, arguments.threads)
    if arguments.look:
        look(arguments.out, arguments.look)


if __name__ == "__main__":
    main()
