"""Synthetic captures of known reflectance, for the benchmark and the tests.

Radiance is written out here once more, in plain NumPy: nothing of it is the code under test.
"""

from dataclasses import dataclass, replace

import numpy as np

from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray
from scan2albedo.reflectance import VertexReflectance, VertexSamples, lobe_slopes, point_light_lobes


@dataclass(frozen=True)
class Capture:
    """Vertices with their truth, and where cameras (J, 3) and flashes (J, 3) of the pictures stand."""

    vertices: FloatArray
    normals: FloatArray
    truth: VertexReflectance
    cameras: FloatArray
    lights: FloatArray
    light: IntArray

    @property
    def parameters(self) -> FloatArray:
        return np.concatenate([self.truth.diffuse_linear, self.truth.weights], axis=1)


def unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def arc(azimuths_deg: FloatArray, elevation_deg: float = 0.0) -> FloatArray:
    """Return positions (N, 3) a metre before a face that looks along +z."""
    azimuth, elevation = np.radians(azimuths_deg), np.radians(elevation_deg)
    level, across = np.full(len(azimuth), np.sin(elevation)), np.cos(elevation)
    return 1000.0 * np.stack([np.sin(azimuth) * across, level, np.cos(azimuth) * across], axis=1)


def studio() -> tuple[FloatArray, FloatArray, IntArray]:
    """Return cameras, lights (J, 3) and light numbers (J,) of all pairs: an arc, two flashes above it."""
    cameras = arc(np.linspace(-60, 60, 9))
    lights = np.concatenate([cameras, arc(np.array([-20.0, 20]), 25)])
    view, light = np.repeat(np.arange(9), 11), np.tile(np.arange(11), 9)
    return cameras[view], lights[light], light


def head_capture(count: int, *, black: float = 0.0) -> Capture:
    """Return a front of a head of `count` vertices with skin and highlights drawn at random.

    `black` is the part of the vertices with a black channel.
    """
    rng = np.random.default_rng(0)
    azimuth, height = rng.uniform(-1.0, 1.0, count), rng.uniform(-0.6, 0.6, count)
    across = np.sqrt(1 - height**2)
    normals = np.stack([np.sin(azimuth) * across, height, np.cos(azimuth) * across], axis=1)
    vertices = normals * [75.0, 100.0, 90.0]
    skin = (
        np.array([0.55, 0.38, 0.30]) * rng.uniform(0.5, 1.4, (count, 1)) * rng.uniform(0.85, 1.15, (count, 3))
    )
    dark = rng.random(count) < black
    skin[dark, rng.integers(0, 3, dark.sum())] = 0.0
    weights = np.abs(rng.normal([0.12, 0.15, 0.10], [0.06, 0.08, 0.06], (count, 3)))
    normals = unit(normals / [75.0, 100.0, 90.0])
    return Capture(vertices, normals, VertexReflectance(skin, weights, np.ones(count, bool)), *studio())


def radiance(capture: Capture) -> tuple[FloatArray, BoolArray]:
    """Return radiance (J, V, 3) by the equation, and where (J, V) n.v > 0.1 and n.l > 0."""
    shape = (len(capture.cameras), len(capture.vertices))
    result, faced = np.zeros((*shape, 3)), np.zeros(shape, bool)
    for j in range(len(capture.cameras)):
        view, light = unit(capture.cameras[j] - capture.vertices), unit(capture.lights[j] - capture.vertices)
        n_v, n_l = ((capture.normals * d).sum(1) for d in (view, light))
        faced[j] = (n_v > 0.1) & (n_l > 0)
        gloss = highlights(capture.truth.weights, capture.normals, view, light)
        lit = capture.truth.diffuse_linear / np.pi * np.maximum(n_l, 0)[:, None] + gloss[:, None]
        result[j] = np.where(n_l > 0, 1.0, 0.0)[:, None] * lit
    return result, faced


def highlights(weights: FloatArray, normals: FloatArray, view: FloatArray, light: FloatArray) -> FloatArray:
    """Return (...) the sum over s = 1, 8, 64 of w_s (s + 2) / (8 pi) (n.h)^s.

    Weights and directions are (..., 3).
    """
    n_h = np.maximum((normals * unit(view + light)).sum(-1), 0)
    lobes = (weights[..., k] * (s + 2) / (8 * np.pi) * n_h**s for k, s in enumerate((1, 8, 64)))
    return np.sum(list(lobes), axis=0)


def samples_of(
    capture: Capture,
    *,
    noise: float = 0.0,
    said_noise: float | None = None,
    shadowed: float = 0.0,
    normals_off_deg: float = 0.0,
) -> VertexSamples:
    """Return noisy samples; `noise` is relative to the radiance's 99th percentile, as is what sigma says.

    `shadowed` is the part of the observations that a shadow nobody knows of darkens to a tenth;
    `normals_off_deg` turns the normals that the fit believes in.
    """
    rng = np.random.default_rng([0, 1])
    clean, faced = radiance(capture)
    white = float(np.percentile(clean[faced], 99))
    shadow = np.where(rng.random(faced.shape) < shadowed, 0.1, 1.0)
    observed = clean * shadow[..., None] + noise * white * rng.standard_normal(clean.shape)
    believed = turned(capture.normals, normals_off_deg, rng)
    sigma = np.full(clean.shape, (said_noise or noise or 1e-7) * white)
    lobes = point_light_lobes(capture.vertices, believed, capture.cameras, capture.lights)
    valid = np.repeat((faced & (lobes[..., 0] > 0))[..., None], 3, axis=2)
    slopes = lobe_slopes(capture.vertices, believed, capture.cameras, capture.lights)
    return VertexSamples(observed, sigma, valid, lobes, capture.light, slopes)


def turned(normals: FloatArray, angle_deg: float, rng: np.random.Generator) -> FloatArray:
    """Return normals turned by `angle_deg` in directions at random."""
    side = unit(np.cross(normals, rng.standard_normal(normals.shape)))
    angle = np.radians(angle_deg)
    return np.cos(angle) * normals + np.sin(angle) * side


def of_pairs(capture: Capture, pairs: IntArray) -> Capture:
    """Return the capture with some of its pictures."""
    return replace(
        capture, cameras=capture.cameras[pairs], lights=capture.lights[pairs], light=capture.light[pairs]
    )
