"""Pictures of lenses under a few lights beside 8,192 directions drawn by brightness.

A frame on a head of a light stage's face model, under lights spread evenly and placed by importance: rms of
errors over the mean brightness, and the error that a hundredth of the pixels exceeds.
"""

from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from worlds.environments import ENVIRONMENTS, reference_lights
from worlds.light_stage import LightStage

from bench.judging import picture_errors as errors
from bench.runner import Bench, Case
from scan2albedo.core.arrays import FloatArray
from scan2albedo.eyeglasses import DistantLights, LensMaterial, LensPictureOptions, Surface, insert_lenses
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.lighting.environment import LightSpread
from scan2albedo.synthetic import GlassesShape, eyeglasses
from scan2albedo.synthetic.renderer import RayScene
from scan2albedo.synthetic.wearer import fit_temples, seat

LIGHTS: dict[LightSpread, tuple[int, ...]] = {"even": (64, 256), "important": (64, 128, 256, 512)}
AT_ONCE = 1024
"""Of the reference's lights."""
SHAPE = GlassesShape(52, 40, 2.4, 18, 5, 3.2, 3.4, 260, 142, 3, 5, 3, 42)
PIXELS = 160
QUICK_PIXELS = 48


@cache
def head_and_frame() -> tuple[Surface, Surface, FloatArray, FloatArray]:
    """Return a frame, a head in one matte colour, the key points (20, 3) and the middle between the eyes."""
    stage = LightStage.load()
    vertices, triangles = stage.shapes["person2"], stage.faces
    eyes = vertices[stage.landmarks[36:48]].mean(0)
    scene = RayScene(vertices, triangles)
    glasses = eyeglasses(shape=SHAPE, bend=fit_temples(SHAPE, 0, scene, eyes))
    world = seat(glasses, scene, eyes)
    frame = Surface(transform_points(world, glasses.vertices), glasses.faces, (0.05, 0.05, 0.06))
    head = Surface(vertices, triangles, (0.5, 0.38, 0.32), roughness_rad=0.3)
    return frame, head, transform_points(world, glasses.keypoints), eyes


def picture(environment: FloatArray, lights: DistantLights, pixels: int) -> FloatArray:
    frame, head, marks, eyes = head_and_frame()
    target = eyes + [0.0, -18.0, -10.0]
    shape = (pixels, pixels)
    return insert_lenses(
        frame,
        marks,
        LensMaterial(dioptres=-3.0, beta=0.04, fresnel=True),
        surfaces=[head],
        camera=look_at(target + [60.0, 20.0, 560.0], target, focal_px=4.0 * pixels, shape=shape),
        shape=shape,
        environment_linear=environment,
        lights=lights,
        options=LensPictureOptions(supersampling=1),
    ).image_linear


@dataclass(frozen=True)
class Lit:
    """An environment and the picture (H, W, 3) under it by the reference's lights."""

    environment: FloatArray
    truth: FloatArray


def lit(name: str, pixels: int) -> Lit:
    environment = ENVIRONMENTS[name]()
    lights = reference_lights(environment)
    toward, strength = np.asarray(lights.directions), np.asarray(lights.irradiance_linear)
    total, nothing = np.zeros((pixels, pixels, 3)), np.zeros((1, 1, 3))
    for start in range(0, len(toward), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        some = DistantLights(toward[part], strength[part])
        # The environment is seen once.
        total += picture(nothing if start else environment, some, pixels)
    return Lit(environment, total)


def few(scene: Lit, kind: LightSpread, count: int) -> FloatArray:
    lights = DistantLights.from_environment(scene.environment, count, kind)
    return picture(scene.environment, lights, len(scene.truth))


def score(scene: Lit, made: FloatArray) -> dict[str, float]:
    rms, worst = errors(made, scene.truth)
    return {"rms %": 100 * rms, "worst of 100 %": 100 * worst}


BENCH = Bench(
    lambda quick: [
        Case(name, partial(lit, name, QUICK_PIXELS if quick else PIXELS)) for name in ENVIRONMENTS
    ],
    methods={
        f"{count} {kind}": partial(few, kind=kind, count=count)
        for kind, counts in LIGHTS.items()
        for count in counts
    },
    score=score,
    warm=True,
)
