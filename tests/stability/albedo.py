"""Extremes of the albedo: the search for the light, its division, soft light, inpainting."""

import math
from dataclasses import replace
from functools import cache, partial

import numpy as np
import trimesh

from scan2albedo.albedo import EstimateOptions, albedo_error, estimate_albedo
from scan2albedo.albedo.inpainting import resynthesize
from scan2albedo.core.geometry_image import GeometryImage
from scan2albedo.geometry.mesh import join
from scan2albedo.lighting.environment import distant_directions
from scan2albedo.lighting.shading import light_from_direction
from scan2albedo.synthetic import Material, face, hemisphere, light_at
from stability.case import BUDGETS, Measured, below, each, refuses, right, said, table, warns
from stability.scenes import with_one

SIZE = 64
SHAPE = (SIZE, SIZE)
SHAPES = {"hemisphere": hemisphere, "face": face}
LAMP = light_at(35, 10)
SHADOWS = EstimateOptions(force=("albedo.shadows",))


@cache
def ball(*lights, material=Material(), texture="skin", size=SIZE, **more):
    """Return a hemisphere and its true albedo; under a lamp at 30 degrees where None is given."""
    lamps = () if lights == (None,) else lights or (light_at(30),)
    return hemisphere(lights=lamps, material=material, texture=texture, size=size, seed=1, **more)


def estimated(scene=None, lights=1, brdf="oren-nayar", **more):
    """Estimate the albedo of a scene, given fields in place of its image's; return it and the truth."""
    scene = scene or ball()
    fields = {name: more.pop(name) for name in list(more) if hasattr(scene.image, name)}
    if "texture_linear" in fields:
        fields["texture_linear"] = fields["texture_linear"].astype(np.float32)
    return estimate_albedo(replace(scene.image, **fields), lights, brdf, **more), scene.albedo_linear


def lit(*lights, **made):
    """Estimate the albedo of a ball made so."""
    return estimated(ball(*lights, **made))


def painted(scale=1.0, shift=0.0, scene=None, lights=1):
    """Estimate the albedo of a ball whose texture is another."""
    scene = scene or ball()
    return estimated(scene, lights, texture_linear=scene.image.texture_linear * scale + shift)


def placed(scale=1.0, shift=0.0):
    """Estimate the albedo of a ball of another size, elsewhere."""
    return estimated(position=ball().image.position * scale + shift)


def masked(*part, of="mask"):
    """Estimate the albedo of a ball whose mask is True in this part alone."""
    return estimated(**{of: with_one(np.zeros(SHAPE, bool), True, part)})


def spoilt(field, value, first=0, last=SIZE):
    """Estimate the albedo of a ball that has another value in a square of a field."""
    square = (slice(first, last), slice(first, last))
    return estimated(**{field: with_one(getattr(ball().image, field), value, square)})


def cut_out(rows, columns, size=SIZE):
    """Estimate the albedo of a part of a ball's image, without any border where the ball fills it."""
    scene = ball(size=size)
    names = ("position", "normal", "mask", "texture_linear")
    image = GeometryImage(*(getattr(scene.image, name)[rows, columns] for name in names))
    return estimate_albedo(image, 1), scene.albedo_linear[rows, columns]


def percent(estimate, truth, mask=None):
    """Return the error of an albedo in per cent."""
    assert estimate.albedo_linear.min() >= 0
    return albedo_error(
        estimate.albedo_linear, truth, estimate.image.mask if mask is None else mask
    ).mse_percent


def off(bound):
    """Return a figure: the error of the albedo, and whether the view is in doubt."""

    def figure(found):
        error = percent(*found)
        assert error < bound, f"albedo off by {error:.3f} %"
        return said(f"albedo off by {error:.3f} %", found[0].plan.of_stage("albedo.view"))

    return figure


def red_off(found):
    """Return the error of the red channel alone."""
    estimate, truth = found
    error = albedo_error(estimate.albedo_linear[..., 0], truth[..., 0], estimate.image.mask).mse_percent
    assert error < 0.05
    return f"red off by {error:.3f} %, mean of the blue {estimate.albedo_linear[..., 2].mean():.2f}"


def red_alone(found):
    """Return the error of the red channel; the others are black."""
    assert not found[0].albedo_linear[..., 1:].any()
    return red_off(found)


def off_where(known, bound):
    """Return a figure: the error where the albedo is known; the confidence elsewhere must be 0."""

    def figure(found):
        estimate, _ = found
        part = known(estimate)
        assert not estimate.confidence[~part].any()
        error = percent(*found, part & estimate.image.mask)
        assert error < bound
        return f"what is seen off by {error:.3f} %, confidence 0 elsewhere"

    return figure


def expected(found):
    """Return the error and the expected one, within twice of which most texels lie."""
    estimate, truth = found
    mask = estimate.image.mask
    wide = estimate.expected_error[mask]
    ratio = estimate.albedo_linear[mask].max(1) / truth[mask].max(1)
    assert np.mean(np.abs(ratio / np.median(ratio) - 1) < 2 * wide) > 0.5
    assert np.median(wide) > 0.02
    return Measured(
        f"albedo off by {percent(*found):.2f} %, an error of {100 * np.median(wide):.0f} % is expected"
    )


def deviation(found):
    """Return the error and the deviation of a noisy albedo."""
    spread = found[0].uncertainty.albedo
    assert spread > 0.1
    return Measured(f"albedo off by {percent(*found):.1f} %, deviation of the albedo {100 * spread:.0f} %")


def out_of_time(found):
    """Return the error of a search that a budget has ended."""
    assert not found[0].converged
    return Measured(f"converged=False, albedo off by {percent(*found):.2f} %")


def constant():
    """Return how much the albedo of a ball of one colour varies, and the number of lamps found."""
    estimate, _ = painted(0.0, 0.5, ball(None, texture="plain", bits=None), "auto")
    albedo = estimate.albedo_linear[estimate.image.mask]
    return 100 * float(albedo.std() / albedo.mean()), len(estimate.lights), estimate


def sure_at_1e12():
    """Estimate the albedo where no lamp reaches, under light of 1e12; what is sure is right."""
    estimate, truth = lit(light_at(30, intensity=1e12))
    dark = estimate.image.mask & ball(light_at(30, intensity=1e12)).shadow[..., 0]
    assert not estimate.confidence[dark].any()
    return percent(estimate, truth, estimate.expected_error < 0.1)


def flat():
    """Estimate the albedo of a flat surface without light."""
    row, column = 1.0 * np.indices(SHAPE)
    position = np.stack([column, -row, 0 * row], -1)
    normal = np.zeros((*SHAPE, 3)) + [0, 0, 1]
    return estimated(ball(None), "auto", normal=normal, position=position)


def occluded(vertices, faces, *lights, options=SHADOWS):
    """Estimate the albedo of a ball with this occluder."""
    return estimated(ball(*lights), options=options, occluder=(vertices, faces))


def doubled():
    """Estimate the albedo of a ball whose occluder is the surface twice."""
    vertices, faces = ball().image.triangulated()
    return occluded(*join([(vertices, faces), (vertices, faces[:, ::-1])]))


def boxed():
    """Estimate the albedo of a ball in a closed box."""
    box = trimesh.creation.box([500, 500, 500])
    return occluded(box.vertices, box.faces, None)


# Soft light.


@cache
def soft_scene(shape, *lights):
    """Return a matt shape under lamps and ambient light of 1."""
    return SHAPES[shape](lights=lights, texture="skin", size=SIZE, seed=1, material=Material(0.0))


TOWARD = distant_directions(96)


def environment(weight, strength):
    """Return an environment of mean radiance `strength` as distant lamps of weights (96,)."""
    share = np.maximum(weight, 0)
    return tuple(
        light_from_direction(toward, math.inf, 4 * strength * part)
        for toward, part in zip(TOWARD, share / share.sum(), strict=True)
        if part > 0
    )


DOME = environment(np.ones(96), 3.0)
BELOW = environment(0.5 - TOWARD[:, 1], 3.0)
WITHIN_60_DEG = environment(1.0 * (TOWARD @ LAMP.direction > 0.5), 0.75)


def soft(shape, *lights, **arguments):
    """Estimate the albedo of a shape in soft light."""
    return estimated(soft_scene(shape, *lights), "auto", **arguments)


def better(bound):
    """Return a figure: the error of the albedo, which is below that of the texture as it came."""

    def figure(found):
        estimate, truth = found
        image = estimate.image
        error, before = percent(*found), albedo_error(image.texture_linear, truth, image.mask).mse_percent
        assert error < bound, f"albedo off by {error:.3f} %"
        assert error <= before + 0.005, f"albedo off by {error:.3f} %, the texture by {before:.3f} %"
        lamps = f"{len(estimate.lights)} lamp(s)" + " and soft light" * (estimate.environment is not None)
        figure = f"albedo off by {error:.3f} %, the texture by {before:.3f} %; {lamps}"
        return said(figure, estimate.plan.of_stage("albedo.view"))

    return figure


def no_lamp(shape):
    """Estimate the albedo under a dome."""
    found = soft(shape, *DOME)
    assert not found[0].lights, "a lamp appeared under a dome"
    return found


def from_below(shape):
    """Estimate the albedo in light from below."""
    found = soft(shape, *BELOW)
    light = found[0].shading[..., 0]
    assert light[3 * SIZE // 4 :].sum() > light[: SIZE // 4].sum()
    return found


def hue(shape):
    """Return the worst channel's error in coloured light, and how much the hue of grey skin varies."""
    scene = soft_scene(shape, LAMP)
    truth = scene.albedo_linear.mean(-1, keepdims=True) * np.ones(3)
    light = 1 + (scene.shading - 1)[..., None] * [1.3, 1.0, 0.7]
    albedo = soft(shape, LAMP, texture_linear=0.2 * truth * light)[0].albedo_linear
    # The colour of the mean light stays in the albedo: each channel has its own scale.
    mask = scene.image.mask
    errors = [albedo_error(albedo[..., c], truth[..., c], mask).mse_percent for c in range(3)]
    ratio = albedo[mask, 0] / np.maximum(albedo[mask, 2], 1e-3)
    varies = float(ratio.std() / ratio.mean())
    assert varies < 0.04
    return max(errors), 100 * varies


def lamp_only():
    """Return the error where a lamp shines, without ambient light."""
    scene = soft_scene("hemisphere", LAMP)
    light = (scene.shading - 1)[..., None]
    estimate, truth = soft("hemisphere", LAMP, texture_linear=0.25 * scene.albedo_linear * light)
    assert estimate.lights
    return percent(estimate, truth, scene.image.mask & (light[..., 0] > 0.3))


def inner_occluder():
    """Estimate the albedo of a surface with an occluder inside it."""
    vertices, faces = soft_scene("hemisphere", LAMP).image.triangulated()
    options = EstimateOptions(force=("albedo.shadows", "albedo.occlusion", "albedo.bounce"))
    return soft("hemisphere", LAMP, options=options, occluder=(0.9 * vertices, faces))


# Inpainting.


def nearly_all():
    """Fill 99 % of a chart; return how far the mean level is from the source's, and the share filled."""
    albedo = ball(None, texture="wood", size=96).albedo_linear[24:-24, 24:-24].astype(float)
    source = with_one(np.zeros(albedo.shape[:2], bool), True, (slice(5), slice(5)))
    filled, known = resynthesize(albedo, ~source, source), albedo[source]
    assert np.array_equal(filled[source], known)
    assert filled.max() <= known.max()
    return 100 * abs(math.log(filled[~source].mean() / known.mean())), 100 * (~source).mean()


CHECKERS = np.indices(SHAPE).sum(0) % 2 == 0
TOO_FEW = "only {} of .* texels can be used"

CASES = table(
    "albedo",
    right(
        off(0.05),
        {
            "no light at all": lambda: lit(None),
            "light at 90 degrees": lambda: lit(light_at(90)),
            "light behind, at 120 degrees": lambda: lit(light_at(120)),
            "five lights": lambda: estimated(
                ball(*(light_at(a, 0.3 * a) for a in (-60, -20, 10, 40, 70))), "auto"
            ),
            "roughness 0": lambda: lit(material=Material(0.0)),
            "texture times 1e-6": lambda: painted(1e-6),
            "mask full, no border": lambda: cut_out(slice(12, 52), slice(12, 52)),
            "flat surface: one normal": flat,
            "occluder coincident with the surface": doubled,
            "occluder of one flat triangle": lambda: occluded(
                np.zeros((3, 3)), [[0, 1, 2]], options=EstimateOptions()
            ),
            "four fifths of it saturated, a quarter white": lambda: lit(exposure=2.8),
        },
    ),
    right(
        off(0.05),
        {
            **each("light of intensity {}", ("0", "1e-12"), lambda i: lit(light_at(30, intensity=i))),
            **each("light at {} degrees", ("89.99", "90.01"), lambda angle: lit(light_at(angle))),
            "light behind, at 180 degrees": lambda: lit(light_at(180)),
            **each("light at the pole (elevation {})", ("90", "-90"), lambda up: lit(light_at(0, up))),
            "lamp inside the head, 1 mm off its centre": lambda: lit(light_at(30, distance_mm=1.0)),
            "lamp at 1e9 mm": lambda: lit(light_at(30, distance_mm=1e9)),
            "two lights of one direction": lambda: estimated(ball(light_at(30), light_at(30)), "auto"),
            **each("roughness {}", ("1e-6", "1"), lambda sigma: lit(material=Material(sigma))),
            "highlight of exponent 1e4": lambda: lit(material=Material(0.3, 0.1, 1e4)),
            "grain finer than a texel": lambda: lit(grain=0.01),
            "grain coarser than the chart": lambda: lit(grain=100.0),
            "image of 3 x 500": lambda: cut_out(slice(255, 258), slice(6, 506), 512),
            "surface in micrometres": lambda: placed(1e3),
            **each("surface {} mm off the origin", ("1e6", "1e7"), lambda far: placed(shift=far)),
            "texels of no area": lambda: spoilt("position", ball().image.position[32, 32], 28, 36),
            "surface collapsed to a point": lambda: placed(0.0),
            "occluder that hides everything": boxed,
            "lights=4 asked of one": lambda: estimated(lights=4),
        },
        slow=True,
    ),
    right(off(0.4), "highlight of exponent 0.1", lambda: lit(material=Material(0.3, 0.1, 0.1)), slow=True),
    right(
        off(0.5),
        "texture partly negative",
        lambda: spoilt("texture_linear", -0.1, 20, 24),
    ),
    right(
        off(0.1), "mask without two texels side by side", lambda: estimated(mask=ball().image.mask & CHECKERS)
    ),
    warns(
        expected,
        {
            "light of intensity 1e12": lambda: lit(light_at(30, intensity=1e12)),
            "lamp 5 mm before the skin": lambda: lit(light_at(30, distance_mm=85.0, intensity=0.1)),
            "lamp 20 mm before the skin": lambda: lit(light_at(30, distance_mm=100.0, intensity=0.5)),
            "highlight of strength 1e3": lambda: lit(material=Material(0.3, 1e3, 20.0)),
        },
    ),
    right(
        below(0.06, "off by {:.3f} % where it is sure, confidence 0 in the dark"),
        "what no lamp reaches, at intensity 1e12",
        sure_at_1e12,
    ),
    warns(deviation, "noise 100 %", lambda: lit(noise=1.0)),
    right(below(2, "albedo constant within {:.2f} %, {} light"), "texture constant", constant),
    right(
        red_off,
        "blue channel {}",
        lambda blue: painted([1, 1, 0], [0, 0, blue], ball(size=128), "auto"),
        ("0", "0.002"),
        slow=True,
    ),
    right(red_alone, "one channel alone", lambda: painted([1, 0, 0])),
    right(
        off_where(lambda estimate: estimate.image.seen, 0.3),
        "70 texels seen of 3209",
        lambda: masked(slice(28, 35), slice(27, 37), of="texture_valid"),
    ),
    right(
        off_where(lambda estimate: estimate.image.mask & estimate.image.normal.any(-1), 0.05),
        "some normals zero",
        lambda: spoilt("normal", 0, 30, 34),
    ),
    warns(
        off(3.0),
        {
            "normals flipped": lambda: estimated(normal=-ball().image.normal),
            "view from behind": lambda: estimated(view_direction=(0, 0, -1)),
        },
    ),
    warns(
        out_of_time,
        {
            f"budget of {name}, {brdf}": partial(estimated, brdf=brdf, budget=budget)
            for name, budget in BUDGETS.items()
            for brdf in ("lambert", "minnaert", "spherical-harmonics")
        },
    ),
    refuses(
        "of these black 3228",
        {
            "texture black": lambda: painted(0.0),
            "texture negative": lambda: painted(0.0, -0.5),
        },
    ),
    refuses(
        "saturated 3228",
        {
            "texture saturated everywhere": lambda: painted(0.0, 1.0),
            "texture HDR 1e6": lambda: painted(1e6),
        },
    ),
    refuses(
        "NaN or infinite values inside the mask",
        {
            "texture with NaN": lambda: spoilt("texture_linear", np.nan, 32, 33),
            "normals NaN": lambda: spoilt("normal", np.nan, 32, 33),
        },
    ),
    refuses(
        "has no texture", "no texture", lambda: estimate_albedo(replace(ball().image, texture_linear=None))
    ),
    refuses("mask .* is empty", "mask empty", lambda: masked(slice(0), slice(0))),
    refuses(TOO_FEW.format(1), "mask of one texel", lambda: masked(32, 32)),
    refuses(TOO_FEW.format(2), "mask of two texels", lambda: masked(32, slice(32, 34))),
    refuses("seen 0", "nothing seen", lambda: masked(slice(0), slice(0), of="texture_valid")),
    refuses("with a normal 0", "all normals zero", lambda: spoilt("normal", 0)),
    refuses("divide them", "normals of length 10", lambda: estimated(normal=10 * ball().image.normal)),
    refuses(TOO_FEW.format(1), "image of 1 x 1", lambda: cut_out(slice(32, 33), slice(32, 33))),
    refuses("only 52 of 52 .* 64 are needed", "image of 8 x 8", lambda: estimated(ball(size=8))),
    refuses(
        "a Lambertian surface has none",
        "roughness asked of Lambert",
        lambda: estimated(brdf="lambert", options=EstimateOptions(force=("albedo.roughness",))),
    ),
    refuses(
        "expected",
        {
            "option sizes=(0, 64, 128)": lambda: EstimateOptions(sizes=(0, 64, 128)),
            "option sizes=(32, 64)": lambda: EstimateOptions(sizes=(32, 64)),
            "option maximal_lights=6": lambda: EstimateOptions(maximal_lights=6),
        },
    ),
    right(better(0.015), {f"dome only, {shape}": partial(no_lamp, shape) for shape in SHAPES}),
    right(
        better(0.02),
        {
            "lamp of 60 degrees' radius, hemisphere": lambda: soft("hemisphere", *WITHIN_60_DEG),
            "environment with its light below, hemisphere": lambda: from_below("hemisphere"),
            "occluder inside the surface": inner_occluder,
        },
    ),
    right(
        better(0.02),
        {
            "lamp of 60 degrees' radius, face": lambda: soft("face", *WITHIN_60_DEG),
            "environment with its light below, face": lambda: from_below("face"),
        },
        slow=True,
    ),
    right(
        below(0.08, "worst channel off by {:.3f} %, hue constant within {:.1f} %"),
        {f"coloured light on grey skin, {shape}": partial(hue, shape) for shape in SHAPES},
    ),
    right(below(0.02, "where it is lit off by {:.3f} %"), "lamp only, no ambient light", lamp_only),
    warns(
        better(0.1),
        "normals inverted, under a dome",
        lambda: soft("face", *DOME, normal=-soft_scene("face", *DOME).image.normal),
    ),
    right(
        below(30, "its mean within {:.0f} % of the source's, {:.0f} % filled"),
        "inpainting 99 % of a chart",
        nearly_all,
    ),
    refuses(
        "texels to copy from or compare with are not finite",
        "inpainting beside NaN",
        lambda: resynthesize(np.full((9, 9, 3), np.nan), CHECKERS[:9, :9], ~CHECKERS[:9, :9]),
    ),
)
