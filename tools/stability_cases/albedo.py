"""Named extremes of the albedo stage: the search for the light, division, inpainting."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scan2albedo.albedo import AlbedoEstimate, EstimateOptions, albedo_error, estimate_albedo
from scan2albedo.albedo.inpainting import resynthesize
from scan2albedo.core import Budget, PointLight
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.synthetic import Material, SyntheticScene, hemisphere, light_at
from stability_cases.case import Cases, Measured, assert_finite, naming, said

CASES = Cases()
STAGE = "albedo"
SIZE = 64
SIDE = (light_at(30),)
QUICK = (
    "no light at all",
    "light at 90 degrees",
    "light behind, at 120 degrees",
    "five lights",
    "roughness 0",
)


@cache
def _ball(
    lights: tuple[PointLight, ...] = SIDE,
    material: Material = Material(),
    texture: Any = "skin",
    size: int = SIZE,
    **more: Any,
) -> SyntheticScene:
    return hemisphere(lights=lights, material=material, texture=texture, size=size, seed=1, **more)


def _with(scene: SyntheticScene, **fields: Any) -> GeometryImage:
    return replace(scene.image, **fields)


def _textured(scene: SyntheticScene, texture: NDArray[np.floating]) -> GeometryImage:
    return _with(scene, texture_linear=texture.astype(np.float32))


def _checked(estimate: AlbedoEstimate) -> AlbedoEstimate:
    """Return the estimate after a look at every array of it."""
    assert_finite(
        estimate.albedo_linear, estimate.shading, estimate.specular, estimate.shadow, estimate.confidence
    )
    assert estimate.albedo_linear.min() >= 0
    assert math.isfinite(estimate.residual)
    if estimate.albedo_deviation is not None:
        assert_finite(estimate.albedo_deviation)
    return estimate


def _error(estimate: AlbedoEstimate, scene: SyntheticScene, mask: NDArray[np.bool_] | None = None) -> float:
    chosen = estimate.image.mask if mask is None else mask
    return albedo_error(_checked(estimate).albedo_linear, scene.albedo_linear, chosen).mse_percent


def _figure(image: GeometryImage, scene: SyntheticScene, bound: float, **arguments: Any) -> str:
    """Estimate, assert the error of the albedo in per cent, and tell it."""
    arguments.setdefault("lights", 1)
    estimate = estimate_albedo(image, **arguments)
    error = _error(estimate, scene)
    assert error < bound, f"albedo off by {error:.3f} %"
    return said(f"albedo off by {error:.3f} %", estimate.plan.of_stage("albedo.view"))


def _scene_figure(bound: float, lights: Sequence[PointLight] = SIDE, **made: Any) -> str:
    asked = made.pop("asked", 1)
    scene = _ball(tuple(lights), **made)
    return _figure(scene.image, scene, bound, lights=asked)


for _name, _bound, _made in (
    ("no light at all", 0.05, {"lights": ()}),
    ("light of intensity 0", 0.05, {"lights": (light_at(30, intensity=0.0),)}),
    ("light of intensity 1e-12", 0.05, {"lights": (light_at(30, intensity=1e-12),)}),
    ("light at 89.99 degrees", 0.1, {"lights": (light_at(89.99),)}),
    ("light at 90 degrees", 0.1, {"lights": (light_at(90),)}),
    ("light at 90.01 degrees", 0.1, {"lights": (light_at(90.01),)}),
    ("light behind, at 120 degrees", 0.1, {"lights": (light_at(120),)}),
    ("light behind, at 180 degrees", 0.05, {"lights": (light_at(180),)}),
    ("light at the pole (elevation 90)", 0.1, {"lights": (light_at(0, 90),)}),
    ("light at the pole (elevation -90)", 0.1, {"lights": (light_at(40, -90),)}),
    ("lamp inside the head, 1 mm off its centre", 0.05, {"lights": (light_at(30, distance_mm=1.0),)}),
    ("lamp at 1e9 mm", 0.05, {"lights": (light_at(30, distance_mm=1e9),)}),
    ("two lights of one direction", 0.05, {"lights": (light_at(30), light_at(30)), "asked": "auto"}),
    (
        "five lights",
        0.1,
        {"lights": tuple(light_at(a, 0.3 * a) for a in (-60, -20, 10, 40, 70)), "asked": "auto"},
    ),
    ("roughness 0", 0.05, {"material": Material(0.0)}),
    ("roughness 1e-6", 0.05, {"material": Material(1e-6)}),
    ("roughness 1", 0.1, {"material": Material(1.0)}),
    ("highlight of exponent 0.1", 0.4, {"material": Material(0.3, 0.1, 0.1)}),
    ("highlight of exponent 1e4", 0.4, {"material": Material(0.3, 0.1, 1e4)}),
    ("grain finer than a texel", 0.1, {"grain": 0.01}),
    ("grain coarser than the chart", 0.5, {"grain": 100.0}),
):

    @CASES.extreme(STAGE, _name, slow=_name not in QUICK)
    def _lit(bound: float = _bound, made: dict[str, Any] = _made) -> str:
        return _scene_figure(bound, **made)


for _name, _made in (
    ("light of intensity 1e12", {"lights": (light_at(30, intensity=1e12),)}),
    ("lamp 5 mm before the skin", {"lights": (light_at(30, distance_mm=85.0, intensity=0.1),)}),
    ("lamp 20 mm before the skin", {"lights": (light_at(30, distance_mm=100.0, intensity=0.5),)}),
    ("highlight of strength 1e3", {"material": Material(0.3, 1e3, 20.0)}),
):

    @CASES.extreme(STAGE, _name, "measured warning")
    def _beyond(made: dict[str, Any] = _made) -> str:
        """What no prior of light expects: the albedo is wrong, and says by how much."""
        scene = _ball(**made)
        estimate = estimate_albedo(scene.image, 1)
        error, mask = _error(estimate, scene), scene.image.mask
        assert estimate.expected_error is not None
        said_error = estimate.expected_error[mask]
        ratio = estimate.albedo_linear[mask].max(1) / scene.albedo_linear[mask].max(1)
        within = float(np.mean(np.abs(ratio / np.median(ratio) - 1) < 2 * said_error))
        half = float(np.median(said_error))
        assert within > 0.5, f"{100 * within:.0f} % within twice the expected error"
        assert half > 0.02, f"expected error {100 * half:.0f} %"
        return Measured(f"albedo off by {error:.2f} %, an error of {100 * half:.0f} % is expected")


@CASES.extreme(STAGE, "what no lamp reaches, at intensity 1e12")
def _unlit() -> str:
    scene = _ball((light_at(30, intensity=1e12),))
    estimate = estimate_albedo(scene.image, 1)
    dark = scene.image.mask & scene.shadow[..., 0]
    assert estimate.expected_error is not None
    sure = _error(estimate, scene, estimate.expected_error < 0.1)
    assert sure < 0.06
    assert not estimate.confidence[dark].any()
    return f"off by {sure:.3f} % where it is sure, confidence 0 in the dark"


@CASES.extreme(STAGE, "noise 100 %", "measured warning")
def _noise() -> str:
    scene = _ball(noise=1.0)
    estimate = estimate_albedo(scene.image, 1)
    assert estimate.uncertainty is not None
    sure = estimate.uncertainty.albedo
    assert sure > 0.1
    return Measured(
        f"albedo off by {_error(estimate, scene):.1f} %, deviation of the albedo {100 * sure:.0f} %"
    )


for _name, _fill, _seen_as in (
    ("black", 0.0, "black 3228"),
    ("saturated everywhere", 1.0, "saturated 3228"),
    ("negative", -0.5, "black 3228"),
):

    @CASES.extreme(STAGE, f"texture {_name}", "named error")
    @naming(_seen_as)
    def _tells_nothing(fill: float = _fill) -> str:
        return _figure(_textured(_ball(), np.full((SIZE, SIZE, 3), fill)), _ball(), 1)


@CASES.extreme(STAGE, "texture partly negative")
def _partly_negative() -> str:
    scene = _ball()
    texture = scene.image.texture_linear.copy()
    texture[20:24, 20:24] = -0.1
    return _figure(_textured(scene, texture), scene, 0.5)


@CASES.extreme(STAGE, "texture constant")
def _constant() -> str:
    scene = _ball((), texture="plain", bits=None)
    estimate = _checked(estimate_albedo(_textured(scene, np.full((SIZE, SIZE, 3), 0.5)), "auto"))
    albedo = estimate.albedo_linear[scene.image.mask]
    spread = float(albedo.std() / albedo.mean())
    assert spread < 0.02
    return f"albedo constant within {100 * spread:.2f} %, {len(estimate.lights)} light"


for _name, _blue in (("black", 0.0), ("an offset of 0.002", 0.002)):

    @CASES.extreme(STAGE, f"blue channel {_name}", slow=True)
    def _no_blue(blue: float = _blue) -> str:
        scene = _ball(size=128)
        texture = scene.image.texture_linear.copy()
        texture[..., 2] = blue
        estimate = _checked(estimate_albedo(_textured(scene, texture)))
        error = albedo_error(estimate.albedo_linear[..., 0], scene.albedo_linear[..., 0], scene.image.mask)
        assert len(estimate.lights) >= 1
        assert error.mse_percent < 0.05
        return f"red off by {error.mse_percent:.3f} %"


@CASES.extreme(STAGE, "one channel alone")
def _one_channel() -> str:
    scene = _ball()
    texture = scene.image.texture_linear * np.array([1, 0, 0])
    estimate = _checked(estimate_albedo(_textured(scene, texture), 1))
    error = albedo_error(estimate.albedo_linear[..., 0], scene.albedo_linear[..., 0], scene.image.mask)
    assert error.mse_percent < 0.1
    assert not estimate.albedo_linear[..., 1:].any()
    return f"red off by {error.mse_percent:.3f} %, the others stay black"


@CASES.extreme(STAGE, "texture HDR 1e6", "named error")
def _hdr() -> str:
    scene = _ball()
    return _figure(_textured(scene, scene.image.texture_linear * 1e6), scene, 1)


for _name, _scale in (("1e-6", 1e-6), ("1e-3", 1e-3)):

    @CASES.extreme(STAGE, f"texture times {_name}")
    def _exposed(scale: float = _scale) -> str:
        scene = _ball()
        image = _textured(scene, scene.image.texture_linear * scale)
        return _figure(image, scene, 0.05)


@CASES.extreme(STAGE, "texture with NaN", "named error")
def _nan_texture() -> str:
    texture = _ball().image.texture_linear.copy()
    texture[32, 32] = np.nan
    return str(_textured(_ball(), texture).shape)


@CASES.extreme(STAGE, "no texture", "named error")
@naming("has no texture")
def _no_texture() -> str:
    return _figure(_with(_ball(), texture_linear=None), _ball(), 1)


@CASES.extreme(STAGE, "mask empty", "named error")
@naming("mask .* is empty")
def _empty() -> str:
    return _figure(_with(_ball(), mask=np.zeros((SIZE, SIZE), bool)), _ball(), 1)


@CASES.extreme(STAGE, "mask of one texel", "named error")
def _one_texel() -> str:
    mask = np.zeros((SIZE, SIZE), bool)
    mask[32, 32] = True
    return _figure(_with(_ball(), mask=mask), _ball(), 1)


@CASES.extreme(STAGE, "mask full, no border")
def _full() -> str:
    scene = _ball()
    part = slice(12, 52)
    image = GeometryImage(
        scene.image.position[part, part],
        scene.image.normal[part, part],
        np.ones((40, 40), bool),
        scene.image.texture_linear[part, part],
    )
    estimate = _checked(estimate_albedo(image, 1))
    error = albedo_error(estimate.albedo_linear, scene.albedo_linear[part, part], image.mask).mse_percent
    assert error < 0.1
    return f"albedo off by {error:.3f} %"


@CASES.extreme(STAGE, "mask without two texels side by side")
def _checkers() -> str:
    scene = _ball()
    mask = scene.image.mask & (np.indices((SIZE, SIZE)).sum(0) % 2 == 0)
    estimate = estimate_albedo(_with(scene, mask=mask), 1)
    assert not estimate.plan.ran("albedo.shadows")
    error = _error(estimate, scene)
    assert error < 0.1
    return f"albedo off by {error:.3f} %, no mesh to cast shadows: told in the plan"


@CASES.extreme(STAGE, "nothing seen", "named error")
@naming("seen 0")
def _unseen() -> str:
    return _figure(_with(_ball(), texture_valid=np.zeros((SIZE, SIZE), bool)), _ball(), 1)


@CASES.extreme(STAGE, "70 texels seen of 3209")
def _hardly_seen() -> str:
    scene = _ball()
    seen = np.zeros((SIZE, SIZE), bool)
    seen[28:35, 27:37] = True
    estimate = _checked(estimate_albedo(_with(scene, texture_valid=seen), 1))
    error = albedo_error(estimate.albedo_linear, scene.albedo_linear, seen).mse_percent
    assert error < 0.3
    assert not estimate.confidence[~seen].any()
    return f"what is seen off by {error:.3f} %, confidence 0 elsewhere"


@CASES.extreme(STAGE, "some normals zero")
def _zero_normals() -> str:
    scene = _ball()
    normal = scene.image.normal.copy()
    normal[30:34, 30:34] = 0
    estimate = _checked(estimate_albedo(_with(scene, normal=normal), 1))
    assert not estimate.confidence[30:34, 30:34].any()
    error = _error(estimate, scene)
    assert error < 0.05
    return f"albedo off by {error:.3f} %, their confidence is 0"


@CASES.extreme(STAGE, "all normals zero", "named error")
def _no_normals() -> str:
    return _figure(_with(_ball(), normal=np.zeros((SIZE, SIZE, 3))), _ball(), 1)


@CASES.extreme(STAGE, "normals NaN", "named error")
def _nan_normals() -> str:
    normal = _ball().image.normal.copy()
    normal[32, 32, 1] = np.nan
    return str(_with(_ball(), normal=normal).shape)


@CASES.extreme(STAGE, "normals flipped", "measured warning")
def _flipped() -> str:
    scene = _ball()
    return _figure(_with(scene, normal=-scene.image.normal), scene, 3.0)


@CASES.extreme(STAGE, "normals of length 10", "named error")
def _long_normals() -> str:
    scene = _ball()
    return _figure(_with(scene, normal=10 * scene.image.normal), scene, 0.05)


def _part(rows: slice, columns: slice, size: int) -> tuple[GeometryImage, NDArray[np.float32]]:
    scene = _ball(size=size)
    image = GeometryImage(
        scene.image.position[rows, columns],
        scene.image.normal[rows, columns],
        scene.image.mask[rows, columns],
        scene.image.texture_linear[rows, columns],
    )
    return image, scene.albedo_linear[rows, columns]


@CASES.extreme(STAGE, "image of 1 x 1", "named error")
def _one() -> str:
    return str(estimate_albedo(_part(slice(32, 33), slice(32, 33), SIZE)[0], 1).residual)


@CASES.extreme(STAGE, "image of 8 x 8", "named error")
def _eight() -> str:
    """It has 52 texels, 64 are needed."""
    scene = _ball(size=8)
    return _figure(scene.image, scene, 2.0)


@CASES.extreme(STAGE, "image of 3 x 500", slow=True)
def _strip() -> str:
    image, truth = _part(slice(255, 258), slice(6, 506), 512)
    estimate = _checked(estimate_albedo(image, 1))
    error = albedo_error(estimate.albedo_linear, truth, image.mask).mse_percent
    assert error < 0.1
    return f"albedo off by {error:.3f} %"


for _name, _scale, _shift in (
    ("surface in micrometres", 1e3, 0.0),
    ("surface in kilometres", 1e-6, 0.0),
    ("surface times 1e6", 1e6, 0.0),
    ("surface 1e6 mm off the origin", 1.0, 1e6),
    ("surface 1e7 mm off the origin", 1.0, 1e7),
):

    @CASES.extreme(STAGE, _name, slow=_scale != 1e-6)
    def _placed(scale: float = _scale, shift: float = _shift) -> str:
        scene = _ball()
        return _figure(_with(scene, position=scene.image.position * scale + shift), scene, 0.05)


@CASES.extreme(STAGE, "texels of no area", slow=True)
def _no_area() -> str:
    scene = _ball()
    position = scene.image.position.copy()
    position[28:36, 28:36] = position[32, 32]
    return _figure(_with(scene, position=position), scene, 0.05)


@CASES.extreme(STAGE, "surface collapsed to a point", slow=True)
def _point() -> str:
    scene = _ball()
    return _figure(_with(scene, position=np.zeros((SIZE, SIZE, 3))), scene, 0.05)


@CASES.extreme(STAGE, "flat surface: one normal")
def _flat() -> str:
    scene = _ball((), texture="skin")
    normal = np.zeros((SIZE, SIZE, 3))
    normal[..., 2] = 1
    x, y = np.meshgrid(np.arange(SIZE), -np.arange(SIZE))
    position = np.stack([x, y, 0 * x], -1).astype(float)
    return _figure(_with(scene, normal=normal, position=position), scene, 0.1, lights="auto")


@CASES.extreme(STAGE, "occluder coincident with the surface")
def _coincident() -> str:
    scene = _ball()
    vertices, faces = scene.image.triangulated()
    twice = np.vstack([vertices, vertices]), np.vstack([faces, faces[:, ::-1] + len(vertices)])
    return _figure(
        _with(scene, occluder=twice), scene, 0.05, options=EstimateOptions(force=("albedo.shadows",))
    )


@CASES.extreme(STAGE, "occluder that hides everything", slow=True)
def _in_a_box() -> str:
    import trimesh

    scene = _ball(())
    box = trimesh.creation.box([500, 500, 500])
    image = _with(scene, occluder=(np.asarray(box.vertices), np.asarray(box.faces)))
    return _figure(image, scene, 0.05, options=EstimateOptions(force=("albedo.shadows",)))


@CASES.extreme(STAGE, "occluder of one flat triangle")
def _flat_occluder() -> str:
    scene = _ball()
    return _figure(_with(scene, occluder=(np.zeros((3, 3)), [[0, 1, 2]])), scene, 0.05)


@CASES.extreme(STAGE, "lights=4 asked of one", slow=True)
def _four() -> str:
    return _figure(_ball().image, _ball(), 0.1, lights=4)


@CASES.extreme(STAGE, "view from behind", "measured warning")
def _view_behind() -> str:
    scene = _ball()
    estimate = estimate_albedo(scene.image, 1, view_direction=(0, 0, -1))
    return said(f"albedo off by {_error(estimate, scene):.3f} %", estimate.plan.of_stage("albedo.view"))


@CASES.extreme(STAGE, "roughness asked of Lambert", "named error")
def _rough_lambert() -> str:
    return _figure(
        _ball().image, _ball(), 1, brdf="lambert", options=EstimateOptions(force=("albedo.roughness",))
    )


for _brdf in ("oren-nayar", "lambert", "minnaert", "spherical-harmonics"):
    for _name, _budget in (("1e-3 s", Budget(seconds=1e-3)), ("1 evaluation", Budget(evaluations=1))):

        @CASES.extreme(STAGE, f"budget of {_name}, {_brdf}", "measured warning", slow=_brdf == "lambert")
        def _spent(budget: Budget = _budget, brdf: str = _brdf) -> str:
            scene = _ball()
            estimate = estimate_albedo(scene.image, 1, brdf, budget=budget)
            assert not estimate.converged
            return Measured(f"converged=False, albedo off by {_error(estimate, scene):.2f} %")


for _wrong in (
    {"sizes": (0, 64, 128)},
    {"sizes": (32, 64)},
    {"maximal_lights": 6},
):

    @CASES.extreme(STAGE, "option " + ", ".join(f"{k}={v}" for k, v in _wrong.items()), "named error")
    def _odd_option(wrong: dict[str, Any] = _wrong) -> str:
        return str(EstimateOptions(**wrong))


@CASES.extreme(STAGE, "four fifths of it saturated, a quarter white")
def _overexposed() -> str:
    scene = _ball(exposure=2.8)
    clipped = scene.image.texture_linear[scene.image.mask] >= 0.995
    some, white = (100 * share.mean() for share in (clipped.any(-1), clipped.all(-1)))
    return f"{some:.0f} and {white:.0f} %; " + _figure(scene.image, scene, 0.1)


@CASES.extreme(STAGE, "everything may not be inpainted")
def _forbidden() -> str:
    scene = _ball(exposure=1.5)
    image = _with(scene, inpaint=np.zeros((SIZE, SIZE), bool))
    estimate = estimate_albedo(image, 1)
    assert not estimate.plan.ran("albedo.inpainting")
    return f"albedo off by {_error(estimate, scene):.2f} %, left out by the annotation: told in the plan"


def _wood(size: int = 96) -> NDArray[np.float64]:
    return _ball((), texture="wood", size=size).albedo_linear.astype(np.float64)[24:-24, 24:-24]


@CASES.extreme(STAGE, "inpainting 99 % of a chart")
def _nearly_all() -> str:
    albedo = _wood()
    side = len(albedo)
    source = np.zeros((side, side), bool)
    source[:5, :5] = True
    filled = resynthesize(albedo, ~source, source)
    assert_finite(filled)
    assert np.array_equal(filled[source], albedo[source])
    off = abs(math.log(float(filled[~source].mean() / albedo[source].mean())))
    assert filled.max() <= albedo[source].max()
    assert off < 0.3
    return f"{100 * (~source).mean():.0f} % filled, its mean within {100 * off:.0f} % of the source's"


@CASES.extreme(STAGE, "inpainting 256 x 256 from one texel", slow=True)
def _from_one() -> str:
    albedo = np.tile(np.linspace(0.2, 0.8, 256)[:, None, None], (1, 256, 3))
    source = np.zeros((256, 256), bool)
    source[3, 250] = True
    filled = resynthesize(albedo, ~source, source)
    assert np.abs(filled - albedo[3, 250]).max() < 1e-6
    return "that texel's colour everywhere"


@CASES.extreme(STAGE, "inpainting beside NaN", "named error")
def _beside_nan() -> str:
    albedo = _wood()
    albedo[10, 10] = np.nan
    target = np.zeros(albedo.shape[:2], bool)
    target[11:14, 10:14] = True
    return str(np.isfinite(resynthesize(albedo, target, ~target)).all())


@CASES.extreme(STAGE, "inpainting without a source")
def _no_source() -> str:
    albedo = _wood()
    everywhere = np.ones(albedo.shape[:2], bool)
    assert np.array_equal(resynthesize(albedo, everywhere, ~everywhere), albedo)
    return "left as it is"


@CASES.extreme(STAGE, "inpainting black, from black")
def _black_hole() -> str:
    albedo = np.zeros((48, 48, 3))
    target = np.zeros((48, 48), bool)
    target[20:28, 20:28] = True
    assert not resynthesize(albedo, target, ~target).any()
    return "stays black"
