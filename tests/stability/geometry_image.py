"""Extremes of `geometry_image`, with a model and without one (`--model none`)."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import trimesh

from scan2albedo import RawScan, fit, geometry_image
from scan2albedo.fitting import FitOptions
from scan2albedo.geometry.mesh import face_areas
from scan2albedo.geometry.rigid import compose
from scan2albedo.sampling import geometry_image_of_scan
from stability.case import Measured, below, each, gap, measured, refuses, right, table, warns
from stability.scenes import TEXTURE_SHAPES, line, mixed, model, person, spoilt, stray, with_one

SIZE = 64


def scan():
    """Return the person's scan."""
    return person().scan


@cache
def face():
    """Return the person's fitted face."""
    options = FitOptions(levels=(0, 1, 1), finest_level=0)
    return fit(scan(), model(), person().model_from_scan, options=options)


def sound(image):
    """Return an image whose normals have unit length."""
    assert image.mask.any()
    np.testing.assert_allclose(np.linalg.norm(image.normal[image.mask], axis=1), 1, atol=1e-9)
    return image


def sampled(sampled_scan=None, size=SIZE, fitted=None, **changes):
    """Sample a scan, with other fields, the person's by default."""
    return sound(geometry_image(fitted or face(), replace(sampled_scan or scan(), **changes), size))


plain = cache(sampled)


def colour_gap(image):
    """Return the mean difference of the colours seen from those of the plain image."""
    both = image.seen & plain().seen
    assert both.sum() > 0.4 * plain().mask.sum()
    return float(np.abs(image.texture_linear - plain().texture_linear)[both].mean())


def moved(distance):
    """Return how far colours are apart when scan and pose are far away."""
    back = compose(np.eye(3), -distance * np.array([1.0, -1.0, 1.0]))
    posed = replace(face(), model_from_scan=face().model_from_scan @ back)
    return colour_gap(sampled(person().shifted(distance).scan, fitted=posed))


def seen_gap(scene):
    """Return by how much the part seen differs from that of the scan as it is, and the part."""
    shares = [sampled(one.painted(0.5)).figures()["seen"] for one in (scene, person())]
    return abs(shares[0] - shares[1]), shares[0]


def area_gap(size):
    """Return by how much the area of all texels differs with their number, and the area in cm2."""
    area, usual = (
        image.figures()["texel_area_mm2"] * image.mask.size for image in (sampled(size=size), plain())
    )
    return abs(area / usual - 1), area / 100


def not_skin(painted):
    """Return the part of the texels seen that a painted texture does not take for skin."""
    # What is alike all over has nothing that tells it from skin.
    image = sampled(texture_linear=painted(scan().texture_linear).astype(np.float32))
    return float(1 - image.skin[image.seen].mean())


def hair(texture):
    """Return a texture of hair all over."""
    grain = np.random.default_rng(0).normal(0, 1, (*texture.shape[:2], 1))
    return (0.1 * np.exp(grain) * np.ones(3)).clip(0, 1)


def even(shape):
    """Return how far an even texture of a shape is from even on the face, and the part seen."""
    image = sampled(texture_linear=np.full((*shape, 3), 0.3, np.float32))
    return gap(image.texture_linear[image.seen], 0.3), image.figures()["seen"]


def black():
    """Return the brightest texel of black vertex colours, and the part seen."""
    image = sampled(person().painted(0))
    return float(image.texture_linear.max()), image.figures()["seen"]


def hardly_seen(image):
    """Return which part of an image is seen."""
    assert image.figures()["seen"] < 0.3
    return Measured(f"seen: {image.figures()['seen']:.0%} of the texels")


def on_chart(uv):
    """Sample the person's scan with another chart."""
    return sampled(fitted=replace(face(), uv=uv))


def flipped_triangle():
    """Return which part of the texels differs by a chart with a flipped triangle."""
    uv, corner = face().uv, face().faces[100]
    image = on_chart(with_one(uv, uv[corner[[0, 2, 1]]], corner))
    return float((np.linalg.norm(image.position - plain().position, axis=2) > 0.5).mean())


# Without a model.

BALL = trimesh.creation.icosphere(3, 100.0)


def charted(vertices=BALL.vertices, faces=BALL.faces, size=SIZE):
    """Return the part of a surface's area that the texels do not show, and the image."""
    mesh = RawScan(np.asarray(vertices, float), np.asarray(faces))
    image = sound(geometry_image_of_scan(mesh, size))
    return 1 - float(image.texel_areas_mm2().sum() / face_areas(mesh.vertices, mesh.faces).sum()), image


def on_ball(scale=1.0, shift=0.0, faces=BALL.faces):
    """Return how far texels are off a ball about their origin, and the part of its area not shown."""
    missing, image = charted(scale * BALL.vertices + shift, faces)
    assert missing < 0.25
    return gap(np.linalg.norm(image.position[image.mask], axis=1) / (100 * scale), 1), missing


def soup():
    """Return the coverage of 2000 loose triangles, whose gaps take the rest."""
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 200, (2000, 1, 3)) + rng.normal(0, 3, (2000, 3, 3))
    missing, image = charted(corners.reshape(-1, 3), np.arange(6000).reshape(-1, 3))
    assert missing > 0.9
    return image.figures()["coverage"]


CORNERS = np.array([[0.0, 0, 0], [100, 0, 0], [50, 1e-4, 0], [50, 80, 0]])
FLAT = np.concatenate([BALL.faces, BALL.faces[:90, [0, 0, 1]]])
COLOURS = "colours {:.0e} apart"

CASES = [
    *table(
        "geometry_image",
        right(
            below(0.1, "{:.0%} off {:.0f} cm2 of surface in the square"), "a size of 8", lambda: area_gap(8)
        ),
        refuses(
            "size .* does not suit",
            {f"a size of {size:g}": partial(sampled, size=size) for size in (7, 64.5, 10**9)},
        ),
        right(below(1e-4, COLOURS), "scan and pose {} mm away", moved, ("1e6", "1e7", "1e9")),
        right(
            below(2e-3, COLOURS),
            "uv moved by {} periods",
            lambda by: colour_gap(sampled(uv=scan().uv + by)),
            ("1", "-5", "1e6"),
        ),
        right(
            below(0.06, "seen: {1:.0%} of the texels"),
            {
                "slivers, coincident vertices, zero-area and non-manifold faces": lambda: seen_gap(
                    spoilt(person())
                ),
                "vertices at 1e20 mm": lambda: seen_gap(stray(person(), 5, 1e20)),
            },
        ),
        right(
            lambda image: "geometry only" if image.texture_linear is None else "",
            {"no uv": lambda: sampled(uv=None), "no texture": lambda: sampled(texture_linear=None)},
        ),
        right(
            below(0.2, "not skin: {:.0%} of the seen texels"),
            {
                "skin: all hair": lambda: not_skin(hair),
                "skin: one colour": lambda: not_skin(lambda texture: 0 * texture + 0.4),
                "skin: a grey texture": lambda: not_skin(
                    lambda texture: texture.mean(-1, keepdims=True) * np.ones(3)
                ),
            },
        ),
        right(
            below(1e-3, "within {:.0e} on the {:.0%} seen"),
            {
                **each("a texture of {}", TEXTURE_SHAPES, even),
                "vertex colours all black": black,
            },
        ),
        warns(
            hardly_seen,
            {
                "uv that span a million periods": lambda: sampled(uv=1e6 * scan().uv),
                "uv all in one place": lambda: sampled(uv=0 * scan().uv + 0.5),
            },
        ),
        right(
            below(0.01, "{:.2%} of the texels differ"), "a chart with a flipped triangle", flipped_triangle
        ),
        refuses(
            r"a texture coordinate is .*, beyond 1e\+12.*leave uv out",
            "uv of 1e300",
            lambda: sampled(uv=1e300 * scan().uv),
        ),
        refuses(
            r"uv holds 2 values that are NaN or infinite, first at \(0, 0, 0\).*repair or re-export",
            "NaN uv",
            lambda: sampled(uv=with_one(scan().uv, np.nan, (0, 0))),
        ),
        refuses(
            r"chart leaves the unit square at \d+ of.*scale its uv",
            "a chart outside the unit square",
            lambda: on_chart(face().uv + 0.5),
        ),
        refuses(
            "chart covers no texel",
            "a chart of one point",
            lambda: on_chart(0 * face().uv),
        ),
        refuses(
            r"has \d+ vertices whose uv are NaN.*check the model",
            "a chart of NaN",
            lambda: on_chart(np.nan * face().uv),
        ),
    ),
    *table(
        "geometry_image (no model)",
        right(
            below(0.02, "{:.1%} off the ball, {:.0%} of its area missing"),
            {
                **each("offset {} mm", ("1e6", "1e7", "1e9"), lambda far: on_ball(shift=far)),
                **each("size times {}", ("1e-6", "1e-3", "1e6", "1e12"), on_ball),
                "mixed orientation": lambda: on_ball(faces=mixed(BALL.faces, 3)),
                "zero-area faces": lambda: on_ball(faces=FLAT),
                "inside out": lambda: on_ball(faces=BALL.faces[:, ::-1]),
            },
        ),
        right(
            below(0.2, "{:.0%} of the area missing"),
            {
                "a size of 512": lambda: charted(size=512),
                "a single triangle": lambda: charted(CORNERS[[0, 1, 3]], [[0, 1, 2]]),
                "a plane with a sliver of aspect 1e6": lambda: charted(
                    CORNERS, [[0, 1, 2], [2, 1, 3], [0, 2, 3]]
                ),
            },
        ),
        right(
            below(0.65, "{:.0%} of both copies' area missing"),
            "every face twice",
            lambda: charted(faces=np.concatenate(2 * [BALL.faces])),
        ),
        right(
            below(0.6, "{:.0%} of its area missing"),
            "a head of 32,000 faces, pinched and in pieces",
            lambda: charted(scan().vertices, scan().faces, 96),
            slow=True,
        ),
        refuses(
            "every face has zero area",
            "a line of points",
            lambda: charted(*line()),
        ),
        refuses(
            "no chart that covers a texel.*remove vertices that lie far",
            "one vertex at 1e11 mm",
            lambda: charted(with_one(BALL.vertices, 1e11)),
        ),
        warns(measured("coverage {:.0%}: gaps between charts take the rest"), "2000 loose triangles", soup),
    ),
]
