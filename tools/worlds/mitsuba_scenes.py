"""The path-traced test set of tests/albedo/mitsuba_scenes, for the benchmark and the tests.

What lit it is Mitsuba's, none of it ours; README.txt there tells how it was made.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import scan2albedo as s2a
from scan2albedo.core.arrays import BoolArray, FloatArray
from scan2albedo.geometry.mesh import normalized
from scan2albedo.io.color import srgb_to_linear

FOLDER = Path(__file__).resolve().parents[2] / "tests" / "albedo" / "mitsuba_scenes"
POSITION_STEP_MM = 0.005
"""Positions are stored as 16-bit multiples of this."""
NORMAL_STEP = 1 / 32767
ALBEDO_STEP = 1 / 65535


@dataclass(frozen=True)
class MitsubaScene:
    """One picture of the set with its truth; images are zero outside the mask.

    Parameters
    ----------
    name : str
    group : str
        The scenes of a group differ in light or texture only.
    image : GeometryImage
        What an estimator is given, texture included. The texel grid itself casts the shadows.
    true_normal : (H, W, 3) float64
        What was rendered; differs from the image's where the scene is about wrong geometry.
    albedo_linear : (H, W, 3) float32
    lights : tuple of PointLight
        Relative to ambient = 1. A soft lamp is told by its centre.
    light_on_value : (H, W) float64
        V of the picture before noise, clipping and 8 bits, divided by V of the albedo: shading,
        interreflection and gloss together, times the exposure.
    clipped : (H, W) bool
        Texels where some channel is at white.
    """

    name: str
    group: str
    image: s2a.GeometryImage
    true_normal: FloatArray
    albedo_linear: NDArray[np.float32]
    lights: tuple[s2a.PointLight, ...]
    light_on_value: FloatArray
    clipped: BoolArray


@dataclass(frozen=True)
class Surface:
    """What the scenes of one geometry share: `normals` and `albedos` by name, all (N, 3) float64."""

    image: s2a.GeometryImage
    normals: dict[str, FloatArray]
    albedos: dict[str, FloatArray]


def scene_names() -> list[str]:
    """Return the names of all scenes in the set's order."""
    return [entry["name"] for entry in _index()]


def load_scenes(names: list[str] | None = None) -> Iterator[MitsubaScene]:
    """Yield the scenes named (all when None).

    Raises
    ------
    ValueError
        For a name that is not in the set.
    """
    if unknown := set(names or ()) - set(scene_names()):
        raise ValueError(f"no scenes {sorted(unknown)} in the set, expected some of {scene_names()}")
    for entry in _index():
        if names is None or entry["name"] in names:
            yield _scene(entry)


def _scene(entry: dict[str, Any]) -> MitsubaScene:
    surface = load_surface(entry["geometry"])
    mask = surface.image.mask
    with np.load(FOLDER / f"{entry['name']}.npz") as stored:
        code, light = stored["texture_srgb"], stored["light_on_value"].astype(float)

    def grid(values: NDArray) -> NDArray:
        full = np.zeros((*mask.shape, *values.shape[1:]), values.dtype)
        full[mask] = values
        return full

    levels = srgb_to_linear(np.arange(256) / 255).astype(np.float32)
    lights = tuple(
        s2a.PointLight(
            float(np.deg2rad(light["azimuth_deg"])),
            float(np.deg2rad(light["elevation_deg"])),
            np.inf if light["distance_mm"] is None else float(light["distance_mm"]),
            float(light["intensity"]),
        )
        for light in entry["lights"]
    )
    return MitsubaScene(
        entry["name"],
        entry["group"],
        replace(
            surface.image, normal=grid(surface.normals[entry["normals"]]), texture_linear=grid(levels[code])
        ),
        grid(surface.normals["true"]),
        grid(surface.albedos[entry["texture"]].astype(np.float32)),
        lights,
        grid(light),
        grid((code == 255).any(1)),
    )


@cache
def load_surface(geometry: str) -> Surface:
    """Return a geometry of the set by name."""
    with np.load(FOLDER / f"{geometry}.npz") as stored:
        fields = dict(stored)
    size = int(fields["size"])
    mask = np.unpackbits(fields["mask"], count=size * size).astype(bool).reshape(size, size)
    position, normal = np.zeros((2, size, size, 3))

    def named(kind: str) -> dict[str, NDArray]:
        return {key.removeprefix(kind): value for key, value in fields.items() if key.startswith(kind)}

    normals = {name: normalized(value * NORMAL_STEP) for name, value in named("normal_").items()}
    position[mask], normal[mask] = fields["position"] * POSITION_STEP_MM, normals["true"]
    image = s2a.GeometryImage(position, normal, mask)
    if "region" in fields:
        region, inpaint = np.full(mask.shape, 255, np.uint8), mask.copy()
        region[mask] = fields["region"]
        inpaint[mask] = np.unpackbits(fields["inpaint"], count=int(mask.sum())).astype(bool)
        image = replace(image, region=region, inpaint=inpaint)
    return Surface(image, normals, {name: value * ALBEDO_STEP for name, value in named("albedo_").items()})


def _index() -> list[dict[str, Any]]:
    return json.loads((FOLDER / "scenes.json").read_text(encoding="utf-8"))
