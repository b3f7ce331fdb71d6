"""Named extremes of the light that the albedo stage takes off: domes, huge lamps, coloured light, none."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from scan2albedo.albedo import AlbedoEstimate, EstimateOptions, albedo_error, estimate_albedo
from scan2albedo.core import PointLight
from scan2albedo.core.arrays import FloatArray
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.synthetic import Material, SyntheticScene, face, hemisphere, light_at
from stability_cases.case import Cases, assert_finite, naming, said

CASES = Cases()
STAGE = "albedo"
SIZE = 64
SHAPES = {"hemisphere": hemisphere, "face": face}
LAMP = light_at(35, 10)


@cache
def _lit(shape: str, lights: tuple[PointLight, ...], texture: str = "skin") -> SyntheticScene:
    """Return a matt shape under lamps and ambient light of 1."""
    return SHAPES[shape](lights=lights, texture=texture, size=SIZE, seed=1, material=Material(0.0))


def _many(weight: Callable[[FloatArray], FloatArray], strength: float) -> tuple[PointLight, ...]:
    """Return an environment of mean radiance `strength` as distant lamps, `weight` of directions (N, 3)."""
    toward = distant_directions(96)
    share = np.maximum(weight(toward), 0)
    return tuple(
        PointLight(math.atan2(x, z), math.asin(y), math.inf, 4 * strength * part)
        for (x, y, z), part in zip(toward.tolist(), (share / share.sum()).tolist(), strict=True)
        if part > 0
    )


def _dome(toward: FloatArray) -> FloatArray:
    return np.ones(len(toward))


def _below(toward: FloatArray) -> FloatArray:
    return np.asarray(0.5 - toward[:, 1])


def _within_60_deg(toward: FloatArray) -> FloatArray:
    return np.asarray((toward @ LAMP.direction > 0.5).astype(float))


def _estimate(image: GeometryImage, options: EstimateOptions = EstimateOptions()) -> AlbedoEstimate:
    estimate = estimate_albedo(image, options=options)
    assert estimate.expected_error is not None
    assert_finite(estimate.albedo_linear, estimate.shading, estimate.confidence, estimate.expected_error)
    assert estimate.albedo_linear.min() >= 0
    return estimate


def _errors(estimate: AlbedoEstimate, truth: FloatArray) -> tuple[float, float]:
    """Return the errors in per cent of the albedo and of the texture as it came."""
    image = estimate.image
    return tuple(  # type: ignore[return-value]
        albedo_error(found, truth, image.mask).mse_percent
        for found in (estimate.albedo_linear, image.texture_linear)
    )


def _told(estimate: AlbedoEstimate, truth: FloatArray, bound: float) -> str:
    """Assert that the albedo errs by less than `bound` per cent and than the texture; tell the figures."""
    error, before = _errors(estimate, truth)
    assert error < bound, f"albedo off by {error:.3f} %"
    assert error <= before + 0.005, f"albedo off by {error:.3f} %, the texture by {before:.3f} %"
    soft = "" if estimate.environment is None else " and soft light"
    return f"albedo off by {error:.3f} %, the texture by {before:.3f} %; {len(estimate.lights)} lamp(s){soft}"


for _shape in SHAPES:

    @CASES.extreme(STAGE, f"dome only, {_shape}")
    def _dome_only(shape: str = _shape) -> str:
        scene = _lit(shape, _many(_dome, 3.0))
        estimate = _estimate(scene.image)
        assert not estimate.lights, "a lamp appeared under a dome"
        return _told(estimate, scene.albedo_linear, 0.015)

    @CASES.extreme(STAGE, f"lamp of 60 degrees' radius, {_shape}", slow=_shape == "face")
    def _huge_lamp(shape: str = _shape) -> str:
        scene = _lit(shape, _many(_within_60_deg, 0.75))
        return _told(_estimate(scene.image), scene.albedo_linear, 0.02)

    @CASES.extreme(STAGE, f"environment with its light below, {_shape}", slow=_shape == "face")
    def _from_below(shape: str = _shape) -> str:
        scene = _lit(shape, _many(_below, 3.0))
        estimate = _estimate(scene.image)
        light = estimate.shading[..., 0]
        assert light[3 * SIZE // 4 :].sum() > light[: SIZE // 4].sum()
        return _told(estimate, scene.albedo_linear, 0.02)

    @CASES.extreme(STAGE, f"coloured light on grey skin, {_shape}", slow=_shape == "face")
    def _coloured(shape: str = _shape) -> str:
        scene = _lit(shape, (LAMP,))
        grey = np.repeat(scene.albedo_linear.mean(-1, keepdims=True), 3, -1)
        light = 1 + (scene.shading - 1)[..., None] * np.array([1.3, 1.0, 0.7])
        image = replace(scene.image, texture_linear=(0.2 * grey * light).astype(np.float32))
        estimate = _estimate(image)
        # The colour of the mean light stays in the albedo: each channel has its own scale.
        errors = [
            albedo_error(estimate.albedo_linear[..., k], grey[..., k], image.mask).mse_percent
            for k in range(3)
        ]
        assert max(errors) < 0.08, errors
        colors = estimate.albedo_linear[image.mask]
        hue = colors[:, 0] / np.maximum(colors[:, 2], 1e-3)
        spread = float(hue.std() / hue.mean())
        assert spread < 0.04, spread
        return f"worst channel off by {max(errors):.3f} %, hue constant within {100 * spread:.1f} %"


@CASES.extreme(STAGE, "grey texture")
def _grey() -> str:
    scene = _lit("hemisphere", (LAMP,))
    truth = np.repeat(scene.albedo_linear.mean(-1, keepdims=True), 3, -1)
    image = replace(scene.image, texture_linear=(0.2 * truth * scene.shading[..., None]).astype(np.float32))
    estimate = _estimate(image)
    assert len(estimate.lights) == 1
    assert np.ptp(estimate.albedo_linear, axis=-1).max() < 1e-6, "colour appeared on a grey surface"
    return _told(estimate, truth, 0.015)


@CASES.extreme(STAGE, "lamp only, no ambient light")
def _lamp_only() -> str:
    scene = _lit("hemisphere", (LAMP,))
    texture = 0.25 * scene.albedo_linear * (scene.shading - 1)[..., None]
    estimate = _estimate(replace(scene.image, texture_linear=texture.astype(np.float32)))
    assert len(estimate.lights) >= 1
    lit = scene.image.mask & (scene.shading - 1 > 0.3)
    error = albedo_error(estimate.albedo_linear, scene.albedo_linear, lit).mse_percent
    assert error < 0.02
    return f"where it is lit off by {error:.3f} %"


@CASES.extreme(STAGE, "mask of two texels", "named error")
@naming("2 ")
def _two_texels() -> str:
    mask = np.zeros((SIZE, SIZE), bool)
    mask[32, 32:34] = True
    return str(_estimate(replace(_lit("hemisphere", (LAMP,)).image, mask=mask)).residual)


@CASES.extreme(STAGE, "normals inverted, under a dome", "measured warning")
def _inverted() -> str:
    scene = _lit("face", _many(_dome, 3.0))
    estimate = _estimate(replace(scene.image, normal=-scene.image.normal))
    return said(_told(estimate, scene.albedo_linear, 0.1), estimate.plan.of_stage("albedo.view"))


@CASES.extreme(STAGE, "occluder inside the surface")
def _inside() -> str:
    scene = _lit("hemisphere", (LAMP,))
    vertices, faces = scene.image.triangulated()
    image = replace(scene.image, occluder=(0.9 * vertices, faces))
    options = EstimateOptions(force=("albedo.shadows", "albedo.occlusion", "albedo.bounce"))
    return _told(_estimate(image, options), scene.albedo_linear, 0.01)
