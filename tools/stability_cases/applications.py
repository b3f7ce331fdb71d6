"""Named extremes of the applications: relit faces, swapped skin, blends, transferred expressions."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from scan2albedo.applications import (
    ProcessedFace,
    TransferOptions,
    blend_faces,
    default_camera,
    relight,
    swap_texture,
    transfer_expression,
)
from scan2albedo.core import PointLight
from scan2albedo.lighting.environment import DistantLights
from scan2albedo.lighting.shading import Reflectance
from scan2albedo.synthetic import Material, face, light_at
from stability_cases.case import Cases, assert_finite, naming

CASES = Cases()
STAGE = "applications"
MATERIAL = Material(0.3, 0.15, 20.0)


@cache
def _person(seed: int = 0, expression: Any = "neutral", size: int = 48) -> ProcessedFace:
    made = face(
        seed, expression=expression, size=size, material=MATERIAL, bits=None, lights=[light_at(30, 15)]
    )
    reflectance = Reflectance(
        "oren-nayar", MATERIAL.sigma_rad, MATERIAL.specular_strength, MATERIAL.specular_exponent
    )
    return ProcessedFace.of(
        f"person{seed}",
        made.image,
        made.albedo_linear,
        reflectance=reflectance,
        lights=made.lights,
        model_name="default",
    )


def _checked(made: ProcessedFace) -> ProcessedFace:
    mask = made.mask
    assert_finite(made.albedo_linear, made.image.position[mask], made.image.normal[mask], made.mesh.vertices)
    assert made.albedo_linear.min() >= 0
    return made


def _with(given: ProcessedFace, **fields: Any) -> ProcessedFace:
    return replace(given, image=replace(given.image, **fields))


def _hiding(given: ProcessedFace, hidden: np.ndarray) -> ProcessedFace:
    return _with(given, texture_valid=given.mask & ~hidden)


@CASES.extreme(STAGE, "relight without a light")
def _dark() -> str:
    one = _person()
    relit = relight(one, [], ambient=0.0)
    assert not relit.texture_linear.any()
    picture = relit.picture(shape=(32, 32), samples=1)
    assert_finite(picture.linear)
    assert not picture.linear.any()
    assert np.array_equal(relight(one).texture_linear[one.mask], one.albedo_linear[one.mask])
    return "black; with ambient light 1 the albedo itself"


@CASES.extreme(STAGE, "relight from behind")
def _behind() -> str:
    one = _person()
    relit = relight(one, [light_at(180)], ambient=0.0)
    assert_finite(relit.texture_linear)
    share = float((relit.texture_linear.max(-1)[one.mask] > 0).mean())
    assert share < 0.02
    return f"{100 * share:.1f} % of the texels lit"


@CASES.extreme(STAGE, "relight at the poles (elevation +-90)")
def _poles() -> str:
    one = _person()
    up, down = (relight(one, [light_at(77, e)], ambient=0.0).texture_linear for e in (90, -90))
    high = one.image.position[..., 1] > np.median(one.image.position[..., 1][one.mask])
    assert_finite(up, down)
    above = [float(lit[one.mask & high].mean() / lit[one.mask & ~high].mean()) for lit in (up, down)]
    assert above[0] > 1.2 > 0.8 > above[1]
    return f"upper over lower half: {above[0]:.1f} from above, {above[1]:.2f} from below"


@CASES.extreme(STAGE, "relight with intensity 0, 1e-12 and 1e12")
def _intensities() -> str:
    one = _person()
    unit = relight(one, [light_at(30, intensity=1.0)], ambient=0.0).texture_linear
    worst = 0.0
    for intensity in (0.0, 1e-12, 1e12):
        lit = relight(one, [light_at(30, intensity=intensity)], ambient=0.0).texture_linear
        off = np.abs(lit.astype(float) - intensity * unit.astype(float)).max()
        worst = max(worst, float(off) / max(intensity, 1e-12))
    assert worst < 1e-5
    return f"linear within {worst:.0e}"


@CASES.extreme(STAGE, "a picture under intensity 1e12")
def _glaring() -> str:
    picture = relight(_person(), [light_at(30, intensity=1e12)]).picture(shape=(48, 48), samples=1)
    shown = picture.srgb()
    assert_finite(picture.linear)
    middle = float(np.median(shown[picture.alpha > 0]))
    assert 40 < middle < 250
    return f"exposed by itself: median {middle:.0f} of 255"


@CASES.extreme(STAGE, "relight with intensity 1e300", "named error")
def _overflow() -> str:
    return str(relight(_person(), [light_at(30, intensity=1e300)]).texture_linear.max())


@CASES.extreme(STAGE, "lamp inside the head", "named error")
def _inside() -> str:
    return str(relight(_person(), [PointLight(0.3, 0.0, 1.0)]).texture_linear.max())


@CASES.extreme(STAGE, "lamp at 1e9 mm")
def _far() -> str:
    one = _person()
    far, distant = (relight(one, [light_at(40, distance_mm=d)]).texture_linear for d in (1e9, math.inf))
    error = float(np.abs(far - distant).max())
    assert error < 1e-5
    return f"as a distant one within {error:.0e}"


@CASES.extreme(STAGE, "five lights, two at one place")
def _five() -> str:
    one = _person()
    lights = [light_at(a) for a in (-60, -20, 20, 60, 60)]
    together = relight(one, lights, ambient=0.0).texture_linear
    alone = sum(relight(one, [light], ambient=0.0).texture_linear for light in lights)
    error = float(np.abs(together - alone).max())
    assert error < 1e-5
    return f"the sum of each alone within {error:.0e}"


@CASES.extreme(STAGE, "environment black")
def _night() -> str:
    relit = relight(_person(), environment_linear=np.zeros((4, 8, 3)))
    assert not relit.texture_linear.any()
    return "black"


@CASES.extreme(STAGE, "environment HDR 1e6 in one direction")
def _sun() -> str:
    sky = np.zeros((16, 32, 3))
    sky[7, 16] = 1e6
    one = _person()
    relit = relight(one, environment_linear=DistantLights.from_environment(sky, 64))
    assert_finite(relit.texture_linear)
    front = one.image.normal[..., 2] > 0.8
    assert (relit.diffuse[one.mask & front] > 0).mean() > 0.9
    return f"finite, at most {relit.texture_linear.max():.0e}"


for _name, _sky in (
    ("negative", -np.ones((4, 8, 3))),
    ("NaN", np.full((4, 8, 3), math.nan)),
    ("without a texel", np.ones((0, 8, 3))),
):

    @CASES.extreme(STAGE, f"environment {_name}", "named error")
    def _odd_sky(sky: np.ndarray = _sky) -> str:
        return str(relight(_person(), environment_linear=sky).texture_linear.max())


@CASES.extreme(STAGE, "picture of 1 x 1", "named error")
def _pixel() -> str:
    return str(relight(_person(), [light_at(0)]).picture(shape=(1, 1)).linear)


@CASES.extreme(STAGE, "picture of 3 x 500")
def _strip() -> str:
    picture = relight(_person(), [light_at(0)]).picture(shape=(3, 500), samples=1)
    assert_finite(picture.linear)
    assert picture.alpha.any()
    return f"{picture.alpha.sum():.0f} pixels of the face"


@CASES.extreme(STAGE, "camera that sees nothing of the face")
def _away() -> str:
    one = _person()
    camera = default_camera(one, (32, 32)).copy()
    camera[:, 3] += camera[:, :3] @ np.array([1e5, 0, 0])
    picture = relight(one, [light_at(0)]).picture(camera, shape=(32, 32), samples=1)
    assert not picture.alpha.any()
    assert_finite(picture.linear, picture.srgb())
    return "an empty picture"


@CASES.extreme(STAGE, "camera inside the head")
def _in_the_head() -> str:
    one = _person()
    camera = default_camera(one, (32, 32)).copy()
    centre = one.mesh.vertices.mean(0) - [0, 0, 30]
    camera[:, 3] = -camera[:, :3] @ centre
    picture = relight(one, [light_at(0)]).picture(camera, shape=(32, 32), samples=1)
    assert_finite(picture.linear)
    return f"finite; {100 * picture.alpha.mean():.0f} % covered: the inside is nothing to see"


for _name, _camera in (
    ("singular", np.zeros((3, 4))),
    ("NaN", np.full((3, 4), math.nan)),
):

    @CASES.extreme(STAGE, f"camera {_name}", "named error")
    def _no_camera(camera: np.ndarray = _camera) -> str:
        return str(relight(_person(), [light_at(0)]).picture(camera, shape=(32, 32)).alpha.sum())


@CASES.extreme(STAGE, "head scaled by 1e3, and by 1e-3")
def _scaled() -> str:
    one = _person()
    here = relight(one, [light_at(60)]).texture_linear
    worst = 0.0
    for scale in (1e3, 1e-3):
        vertices, faces = one.image.occluder_mesh()
        image = replace(one.image, position=scale * one.image.position, occluder=(scale * vertices, faces))
        mesh = replace(one.mesh, vertices=scale * one.mesh.vertices)
        there = relight(replace(one, image=image, mesh=mesh), [light_at(60)]).texture_linear
        worst = max(worst, float((np.abs(there - here).max(-1) > 0.02)[one.mask].mean()))
    assert worst < 0.02
    return f"shadows differ at {100 * worst:.1f} % of the texels"


@CASES.extreme(STAGE, "albedo NaN", "named error")
@naming("the albedo is .* or holds NaN")
def _nan_albedo() -> str:
    albedo = _person().albedo_linear.copy()
    albedo[24, 24] = math.nan
    return str(replace(_person(), albedo_linear=albedo).level())


@CASES.extreme(STAGE, "albedo negative", "named error")
def _negative_albedo() -> str:
    return str(replace(_person(), albedo_linear=-_person().albedo_linear).level())


@CASES.extreme(STAGE, "mask empty", "named error")
def _no_face() -> str:
    empty = replace(_person().image, mask=np.zeros((48, 48), bool))
    return str(
        relight(ProcessedFace.of("nobody", empty, np.zeros((48, 48, 3))), [light_at(0)]).texture_linear
    )


@CASES.extreme(STAGE, "mask of one texel", "named error")
def _one_texel() -> str:
    mask = np.zeros((48, 48), bool)
    mask[24, 24] = _person().mask[24, 24]
    image = replace(_person().image, mask=mask, occluder=None)
    one = ProcessedFace.of("texel", image, _person().albedo_linear)
    return str(relight(one, [light_at(0)]).texture_linear[24, 24])


@CASES.extreme(STAGE, "blend weights 0 and 1")
def _ends() -> str:
    a, b = _person(0), _person(1)
    for weight, end in ((0.0, a), (1.0, b)):
        made = _checked(blend_faces(a, b, weight))
        assert np.abs(made.mesh.vertices - end.mesh.vertices).max() < 1e-9
        assert np.abs(made.albedo_linear - end.albedo_linear)[end.mask].max() < 1e-6
    return "the faces themselves"


@CASES.extreme(STAGE, "blend of a face with itself")
def _self() -> str:
    one = _person()
    made = _checked(blend_faces(one, one, 0.3))
    error = float(np.abs(made.albedo_linear - one.albedo_linear)[one.mask].max())
    assert error < 1e-6
    return f"itself within {error:.0e}"


@CASES.extreme(STAGE, "blend with a black face")
def _black() -> str:
    one = _person(0)
    black = replace(_person(1), albedo_linear=np.zeros((48, 48, 3), np.float32))
    made = _checked(blend_faces(one, black, 0.5))
    ratio = float(made.albedo_linear[one.mask].mean() / one.albedo_linear[one.mask].mean())
    assert abs(ratio - 0.5) < 0.01
    return f"half as bright: {ratio:.2f}"


@CASES.extreme(STAGE, "blend of opposite faces: normals cancel")
def _cancelled() -> str:
    one = _person(0)
    turned = replace(
        one,
        image=replace(one.image, position=-one.image.position, normal=-one.image.normal, occluder=None),
        mesh=replace(one.mesh, vertices=-one.mesh.vertices),
    )
    made = blend_faces(one, turned, 0.5)
    assert_finite(made.image.normal, made.albedo_linear)
    relit = relight(replace(made, casts_shadows=False), [light_at(0)])
    assert_finite(relit.texture_linear)
    return "a point: finite, ambient light alone"


for _name, _make in (
    ("blend", lambda a, b: blend_faces(a, b, 0.5)),
    ("swap", swap_texture),
):

    @CASES.extreme(STAGE, f"{_name}: seen texels of A and B disjoint")
    def _disjoint(make: Any = _make) -> str:
        a, b = _person(0), _person(1)
        left = np.arange(48)[None, :] < 24
        made = _checked(make(_hiding(a, ~left), _hiding(b, left)))
        whole = _checked(make(a, b))
        off = np.abs(np.log(made.albedo_linear[a.mask].mean() / whole.albedo_linear[a.mask].mean()))
        assert off < 0.3
        return f"whole skin, its level within {100 * off:.0f} % of the one of faces seen whole"

    @CASES.extreme(STAGE, f"{_name}: nothing seen of either")
    def _unseen(make: Any = _make) -> str:
        a, b = _person(0), _person(1)
        made = _checked(make(_hiding(a, a.mask), _hiding(b, b.mask)))
        return f"finite, mean {made.albedo_linear[a.mask].mean():.2f}"

    @CASES.extreme(STAGE, f"{_name}: charts disjoint", "named error")
    def _charts(make: Any = _make) -> str:
        a = _person(0)
        left = np.arange(48)[None, :] < 24
        parts = []
        for side in (left, ~left):
            image = replace(a.image, mask=a.mask & side, occluder=None)
            parts.append(ProcessedFace.of("half", image, a.albedo_linear, model_name="default"))
        return str(make(*parts).level())


@CASES.extreme(STAGE, "zero expression")
def _still() -> str:
    a, b = _person(0), _person(1)
    made = _checked(transfer_expression(a, a, b))
    moved = float(np.abs(made.mesh.vertices - b.mesh.vertices).max())
    assert moved < 1e-6
    return f"B itself within {moved:.0e} mm"


@CASES.extreme(STAGE, "expression of strength 0")
def _mild() -> str:
    a, smile, b = _person(0), _person(0, "smile"), _person(1)
    made = _checked(transfer_expression(a, smile, b, options=TransferOptions(strength=0.0)))
    moved = float(np.abs(made.mesh.vertices - b.mesh.vertices).max())
    assert moved == 0
    return "B itself"


@CASES.extreme(STAGE, "expression on a face 1e3 times larger")
def _giant() -> str:
    a, smile, b = _person(0), _person(0, "smile"), _person(1)
    image = replace(b.image, position=1e3 * b.image.position, occluder=None)
    giant = replace(b, image=image, mesh=replace(b.mesh, vertices=1e3 * b.mesh.vertices))
    made = _checked(transfer_expression(a, smile, giant))
    moved, own = (
        float(np.linalg.norm(new.mesh.vertices - old.mesh.vertices, axis=1).max())
        for new, old in ((made, giant), (smile, a))
    )
    assert 0.2 * own < moved < 5 * own
    return f"moves by {moved:.0f} mm at most, A by {own:.0f}"
