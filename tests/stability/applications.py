"""Extremes of the applications: relit faces, swapped skins, blends, transferred expressions."""

import math
from dataclasses import replace

import numpy as np
from helpers.faces import painted, unseen
from helpers.processed_faces import processed_person

from scan2albedo.applications import (
    ProcessedFace,
    blend_faces,
    default_camera,
    relight,
    swap_texture,
    transfer_expression,
)
from scan2albedo.core import PointLight
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.synthetic import light_at
from stability.case import below, gap, refuses, right, table
from stability.scenes import with_one

SIZE = 48
LEFT = np.arange(SIZE)[None, :] < SIZE // 2
MIDDLE = with_one(np.zeros((SIZE, SIZE), bool), True, (24, 24))


def person(seed=0, expression="neutral"):
    """Return a synthetic person as if it had been processed."""
    return processed_person(seed, expression, SIZE)


def changed(face, **fields):
    """Return a face with other fields of its image."""
    return replace(face, image=replace(face.image, **fields))


def scaled(face, scale):
    """Return a face of another size."""
    vertices, faces = face.image.occluder_mesh()
    larger = changed(face, position=scale * face.image.position, occluder=(scale * vertices, faces))
    return replace(larger, mesh=replace(face.mesh, vertices=scale * face.mesh.vertices))


def lit(*lights):
    """Return the texture of the person under lights alone."""
    return relight(person(), lights, ambient=0.0).texture_linear


def under(sky, count=4):
    """Relight the person by an environment."""
    return relight(person(), environment_linear=DistantLights.from_environment(sky, count))


def on(mask):
    """Relight the person's face cut down to a mask."""
    image = replace(person().image, mask=mask, occluder=None)
    return relight(ProcessedFace.of("cut", image, person().albedo_linear), [light_at(0)])


def pictured(shape=(32, 32), camera=None, lamp=light_at(0)):
    """Return a picture of the relit person, linear and as shown."""
    picture = relight(person(), [lamp]).picture(camera, shape=shape, samples=1)
    return picture, picture.linear, picture.srgb()


def seen(found):
    """Return how much of a picture a face covers."""
    return f"finite; {found[0].alpha.sum():.0f} pixels covered"


def from_place(offset, moved=True):
    """Return a picture by a camera moved so far, or put at that place."""
    camera = default_camera(person(), (32, 32)).copy()
    camera[:, 3] = (camera[:, 3] if moved else 0) - camera[:, :3] @ np.asarray(offset, float)
    return pictured(camera=camera)


def lit_part(*lights):
    """Return which part of the texels lights reach, and the texture."""
    texture = lit(*lights)
    return float((texture.max(-1)[person().mask] > 0).mean()), texture


def poles():
    """Return how much brighter the upper half of the face is under light from above, and from below."""
    mask, height = person().mask, person().image.position[..., 1]
    high = height > np.median(height[mask])
    ratios = []
    for elevation in (90, -90):
        texture = lit(light_at(77, elevation))
        ratios.append(float(texture[mask & high].mean() / texture[mask & ~high].mean()))
    assert ratios[0] > 1.2
    return ratios[1], ratios[0]


def not_linear():
    """Return how far the texture is from being linear in a lamp's intensity."""
    unit = lit(light_at(30, intensity=1.0)).astype(float)
    return max(
        gap(lit(light_at(30, intensity=strength)), strength * unit) / max(strength, 1e-12)
        for strength in (0.0, 1e-12, 1e12)
    )


def exposed():
    """Return how far the middle of a picture under light of 1e12 is from grey, and the middle."""
    picture, *_ = pictured((48, 48), lamp=light_at(30, intensity=1e12))
    middle = float(np.median(picture.srgb()[picture.alpha > 0]))
    return abs(middle - 145), middle


def far_lamp():
    """Return how far a lamp at 1e9 mm is from a distant one."""
    far, distant = (lit(light_at(40, distance_mm=distance)) for distance in (1e9, math.inf))
    return gap(far, distant)


def sun():
    """Return which part of the front a bright texel of the sky does not reach, and the brightest texel."""
    sky = np.zeros((16, 32, 3))
    sky[7, 16] = 1e6
    relit = under(sky, 64)
    front = person().mask & (person().image.normal[..., 2] > 0.8)
    return float((relit.diffuse[front] == 0).mean()), relit.texture_linear.max(), relit.texture_linear


def other_size(scale):
    """Return at which part of the texels shadows of a scaled head differ."""
    here, there = (
        relight(face, [light_at(60)]).texture_linear for face in (person(), scaled(person(), scale))
    )
    return float((np.abs(there - here).max(-1) > 0.02)[person().mask].mean())


def blended(a, b):
    """Return the blend of two faces, half and half."""
    return blend_faces(a, b, 0.5)


def black():
    """Return how far a blend with a black face is from half as bright."""
    one = person()
    made = blended(one, painted(person(1), person(1).mask, 0))
    return abs(float(made.albedo_linear[one.mask].mean() / one.albedo_linear[one.mask].mean()) - 0.5)


def opposite():
    """Relight the blend of a face and its opposite, whose normals cancel."""
    one = person()
    turned = changed(one, position=-one.image.position, normal=-one.image.normal, occluder=None)
    turned = replace(turned, mesh=replace(one.mesh, vertices=-one.mesh.vertices))
    made = blended(one, turned)
    relit = relight(replace(made, casts_shadows=False), [light_at(0)])
    return gap(made.image.position[made.mask], 0), made.image.normal, relit.texture_linear


def halves(make):
    """Return how far the level of a skin, each face having seen a half, is from the whole one."""
    a, b = person(), person(1)
    hidden = unseen(a, ~LEFT), unseen(b, LEFT)
    parts, whole = (make(*faces).albedo_linear[a.mask].mean() for faces in (hidden, (a, b)))
    return 100 * float(np.abs(np.log(parts / whole)))


def nothing_seen(make):
    """Return how far a skin that nobody saw is from grey, and its mean."""
    made = make(*(unseen(person(seed), person().mask) for seed in (0, 1))).albedo_linear[person().mask]
    return abs(made.mean() - 0.5), made.mean(), made


def apart(make):
    """Bring two halves of a face together."""
    a = person()
    images = (replace(a.image, mask=a.mask & side, occluder=None) for side in (LEFT, ~LEFT))
    return make(*(ProcessedFace.of("half", i, a.albedo_linear, model_name=a.model_name) for i in images))


def giant():
    """Return how far the movement of a face 1e3 times larger is from A's: the log of the ratio, and both."""
    a, smile, larger = person(), person(0, "smile"), scaled(person(1), 1e3)
    made = transfer_expression(a, smile, larger)
    moved, own = (
        float(np.linalg.norm(new.mesh.vertices - old.mesh.vertices, axis=1).max())
        for new, old in ((made, larger), (smile, a))
    )
    return abs(math.log(moved / own)), moved, own


WITHIN = below(1e-5, "within {:.0e}")
MAKERS = {"blend": blended, "swap": swap_texture}

CASES = table(
    "applications",
    right(below(0.02, "{:.1%} of the texels lit"), "relight from behind", lambda: lit_part(light_at(180))),
    right(
        below(0.8, "upper over lower half: {:.2f} from below, {:.1f} from above"),
        "relight at the poles (elevation +-90)",
        poles,
    ),
    right(WITHIN, "relight with intensity 0, 1e-12 and 1e12", not_linear),
    right(below(105, "exposed by itself: median {1:.0f} of 255"), "a picture under intensity 1e12", exposed),
    right(WITHIN, "lamp at 1e9 mm", far_lamp),
    right(
        below(0.1, "{:.0%} of the front not lit, at most {:.0e}"), "environment HDR 1e6 in one direction", sun
    ),
    right(
        seen,
        {
            "picture of 3 x 500": lambda: pictured((3, 500)),
            "camera that sees nothing of the face": lambda: from_place([-1e5, 0, 0]),
            "camera inside the head": lambda: from_place(person().mesh.vertices.mean(0) - [0, 0, 30], False),
        },
    ),
    right(
        below(0.02, "shadows differ at {:.1%} of the texels"),
        "head scaled by {}",
        other_size,
        ("1e3", "1e-3"),
    ),
    refuses(
        "",
        {
            "relight with intensity 1e300": lambda: lit(light_at(30, intensity=1e300)),
            "lamp inside the head": lambda: lit(PointLight(0.3, 0.0, 1.0)),
            "environment negative": lambda: relight(person(), environment_linear=-np.ones((4, 8, 3))),
            "environment NaN": lambda: under(np.full((4, 8, 3), math.nan)),
            "environment without a texel": lambda: under(np.ones((0, 8, 3))),
            "picture of 1 x 1": lambda: pictured((1, 1)),
            "camera singular": lambda: pictured(camera=np.zeros((3, 4))),
            "camera NaN": lambda: pictured(camera=np.full((3, 4), math.nan)),
            "albedo negative": lambda: replace(person(), albedo_linear=-person().albedo_linear),
            "mask empty": lambda: on(MIDDLE & False),
            "mask of one texel": lambda: on(MIDDLE),
        },
    ),
    refuses(
        "the albedo is .* or holds NaN",
        "albedo NaN",
        lambda: painted(person(), MIDDLE, math.nan),
    ),
    right(below(0.01, "half as bright within {:.2f}"), "blend with a black face", black),
    right(
        below(1e-9, "a point within {:.0e} mm: finite, ambient light alone"),
        "blend of opposite faces: normals cancel",
        opposite,
    ),
    right(
        below(30, "whole skin, its level within {:.0f} % of the one of faces seen whole"),
        "{}: seen texels of A and B disjoint",
        halves,
        MAKERS,
    ),
    right(below(0.5, "finite, mean {1:.2f}"), "{}: nothing seen of either", nothing_seen, MAKERS),
    refuses("", "{}: charts disjoint", apart, MAKERS),
    right(
        below(1.6, "moves by {1:.0f} mm at most, A by {2:.0f}"),
        "expression on a face 1e3 times larger",
        giant,
    ),
)
