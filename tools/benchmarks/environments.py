"""Environment maps to light things with, and the many lights that pictures under them are compared with."""

from __future__ import annotations

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.lighting.environment import DistantLights

_REFERENCE = 8192


def studio(rows: int = 128) -> FloatArray:
    """Return a dim room (rows, 2 rows, 3) with three softboxes with sharp edges."""
    toward = _toward(rows)
    image = np.full((rows, 2 * rows, 3), 0.08)
    for way, half, color in (
        ((-0.7, 0.5, 0.6), (0.30, 0.22), (9.0, 8.6, 8.0)),
        ((0.9, 0.1, 0.4), (0.15, 0.45), (2.5, 2.7, 3.2)),
        ((0.2, 0.9, 0.1), (0.4, 0.1), (4.0, 4.0, 4.0)),
    ):
        axis = np.array(way) / np.linalg.norm(way)
        side = np.cross([0.0, 1.0, 0.0], axis)
        side /= np.linalg.norm(side)
        up, depth = np.cross(axis, side), toward @ axis
        inside = (np.abs(toward @ side) < half[0] * depth) & (np.abs(toward @ up) < half[1] * depth)
        image[inside] = color
    return image


def sky(rows: int = 128) -> FloatArray:
    """Return a hazy sky (rows, 2 rows, 3) over dark ground, the sun's disc six degrees wide."""
    toward = _toward(rows)
    height = toward[..., 1]
    image = np.where(height[..., None] > 0, [0.35, 0.5, 0.9], [0.12, 0.1, 0.08]).astype(np.float64)
    image += np.clip(1 - np.abs(height), 0, 1)[..., None] ** 4 * 0.3
    sun = np.array([0.5, 0.7, 0.6]) / np.linalg.norm([0.5, 0.7, 0.6])
    image += np.where(toward @ sun > np.cos(np.deg2rad(3.0)), 120.0, 0.0)[..., None] * [1.0, 0.95, 0.85]
    return image


def _toward(rows: int) -> FloatArray:
    polar = ((np.arange(rows) + 0.5) * np.pi / rows)[:, None]
    azimuth = ((np.arange(2 * rows) + 0.5) / (2 * rows) - 0.5) * 2 * np.pi
    parts = np.sin(polar) * np.sin(azimuth), np.cos(polar) + 0 * azimuth, np.sin(polar) * np.cos(azimuth)
    return np.stack(parts, -1)


ENVIRONMENTS = {"studio": studio, "sky": sky}


def reference_lights(environment: FloatArray, count: int = _REFERENCE) -> DistantLights:
    """Return lights drawn by brightness, stratified and jittered, each of radiance over density.

    It shares nothing with the lights that are measured: no lattice, no cells.
    """
    rows, columns = environment.shape[:2]
    edges = np.cos(np.arange(rows + 1) * np.pi / rows)
    size = np.repeat((edges[:-1] - edges[1:]) * 2 * np.pi / columns, columns)
    flat = environment.reshape(-1, 3)
    share = flat.mean(1) * size
    share = 0.7 * share / share.sum() + 0.3 * size / size.sum()
    rng = np.random.default_rng(0)
    drawn = np.searchsorted(np.cumsum(share), (np.arange(count) + rng.random(count)) / count)
    drawn = np.minimum(drawn, len(share) - 1)
    row, column = np.divmod(drawn, columns)
    y = edges[row] + rng.random(count) * (edges[row + 1] - edges[row])
    azimuth = ((column + rng.random(count)) / columns - 0.5) * 2 * np.pi
    across = np.sqrt(np.maximum(1 - y * y, 0))
    toward = np.stack([across * np.sin(azimuth), y, across * np.cos(azimuth)], 1)
    return DistantLights(toward, flat[drawn] * (size / share / count)[drawn, None])


def errors(made: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Return the rms of errors over the mean brightness, and the one that a hundredth exceeds."""
    off = np.abs(made - truth).mean(2) / truth.mean()
    return float(np.sqrt((off**2).mean())), float(np.percentile(off, 99))
