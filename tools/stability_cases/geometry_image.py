"""The extremes of `geometry_image`, with a model and without one (`--model none`)."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cache

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from scan2albedo import FittedFace, GeometryImage, RawScan, fit, geometry_image
from scan2albedo.errors import GeometryImageError
from scan2albedo.fitting import FitOptions
from scan2albedo.geometry.mesh import face_areas
from scan2albedo.geometry.rigid import compose
from scan2albedo.sampling import geometry_image_of_scan
from stability_cases.case import Cases, Measured, assert_finite, naming
from stability_cases.scanned_person import model, person, spoilt, stray

CASES = Cases()
STAGE = "geometry_image"
SIZE = 64


@cache
def face() -> FittedFace:
    """Return the person's fitted face."""
    options = FitOptions(levels=(0, 1, 1), finest_level=0)
    return fit(person().scan, model(), person().model_from_scan, options=options)


@cache
def plain() -> GeometryImage:
    """Return the geometry image that extremes are compared with."""
    return geometry_image(face(), person().scan, SIZE)


def sampled(scan: RawScan, fitted: FittedFace | None = None, size: int = SIZE) -> GeometryImage:
    """Sample, and see that all is finite and the normals have unit length."""
    image = geometry_image(fitted or face(), scan, size)
    _see_sound(image)
    return image


def _see_sound(image: GeometryImage) -> None:
    assert_finite(image.position, image.normal)
    if image.texture_linear is not None:
        assert_finite(image.texture_linear)
    assert image.mask.any()
    np.testing.assert_allclose(np.linalg.norm(image.normal[image.mask], axis=1), 1, atol=1e-9)


def colour_gap(image: GeometryImage) -> float:
    """Return the mean difference of the colours seen from those of the plain image."""
    both = image.seen & plain().seen
    assert both.sum() > 0.4 * plain().mask.sum()
    assert image.texture_linear is not None
    assert plain().texture_linear is not None
    return float(np.abs(image.texture_linear - plain().texture_linear)[both].mean())


def unseen(image: GeometryImage) -> Measured:
    """Return the figure of an image that has seen nothing."""
    assert image.figures()["seen"] == 0
    return Measured("seen: 0 % of the texels")


@CASES.extreme(STAGE, "sizes of 8 and 64")
def _() -> str:
    images = [sampled(person().scan, size=size) for size in (8, SIZE)]
    cells = [
        image.figures()["texel_area_mm2"] * size**2 for image, size in zip(images, (8, SIZE), strict=True)
    ]
    assert abs(cells[0] / cells[1] - 1) < 0.1
    return f"{cells[0] / 100:.0f} and {cells[1] / 100:.0f} cm2 of surface in the square"


@CASES.extreme(STAGE, "a size of 2048", slow=True)
def _() -> str:
    image = sampled(person().scan, size=2048)
    area = image.figures()["texel_area_mm2"] * 2048**2 / (plain().figures()["texel_area_mm2"] * SIZE**2)
    assert abs(area - 1) < 0.05
    return f"{image.figures()['seen']:.0%} of {int(image.mask.sum())} texels seen"


@CASES.extreme(STAGE, "a size of 7, of 64.5 or of a billion", "named error")
def _() -> str:
    for size in (7, 10**9):
        with suppress(GeometryImageError):
            sampled(person().scan, size=size)
            raise AssertionError(f"size {size} passed")
    with naming("size 64.5 does not suit", "whole number of texels"):
        sampled(person().scan, size=64.5)  # type: ignore[arg-type]
    return "sampled"


@CASES.extreme(STAGE, "scan and pose 1e6, 1e7 and 1e9 mm away")
def _() -> str:
    gaps = []
    for distance in (1e6, 1e7, 1e9):
        far = person().shifted(distance)
        back = compose(np.eye(3), -distance * np.array([1.0, -1.0, 1.0]))
        posed = replace(face(), model_from_scan=face().model_from_scan @ back)
        gaps.append(colour_gap(sampled(far.scan, posed)))
    assert max(gaps) < 1e-4
    return f"colours {max(gaps):.0e} apart"


@CASES.extreme(STAGE, "slivers, coincident vertices, zero-area and non-manifold faces; vertices at 1e20 mm")
def _() -> str:
    bare = geometry_image(face(), _bare(person().scan), SIZE)
    shares = []
    for scan in (spoilt(person()).scan, stray(person(), 5, 1e20).scan):
        image = sampled(_bare(scan))
        shares.append(image.figures()["seen"])
        assert abs(shares[-1] - bare.figures()["seen"]) < 0.06
    return f"seen: {shares[0]:.0%} and {shares[1]:.0%} of the texels ({bare.figures()['seen']:.0%})"


def _bare(scan: RawScan) -> RawScan:
    """Return a scan with grey vertex colours in place of its texture."""
    grey = np.full((len(scan.vertices), 3), 0.5, np.float32)
    return RawScan(scan.vertices, scan.faces, vertex_color_linear=grey, name=scan.name)


@CASES.extreme(STAGE, "no uv; no texture")
def _() -> str:
    for scan in (replace(person().scan, uv=None), replace(person().scan, texture_linear=None)):
        assert sampled(scan).texture_linear is None
    return "geometry only"


@CASES.extreme(STAGE, "skin: all hair, one colour, a grey texture")
def _() -> str:
    random = np.random.default_rng(0)
    texture = person().scan.texture_linear
    assert texture is not None
    hair = (0.1 * np.exp(random.normal(0, 1, (*texture.shape[:2], 1))) * np.ones(3)).clip(0, 1)
    grey = np.repeat(texture.mean(-1, keepdims=True), 3, 2)
    shares = []
    for painted in (hair, np.full_like(texture, 0.4), grey):
        image = sampled(replace(person().scan, texture_linear=painted.astype(np.float32)))
        assert image.skin is not None
        shares.append(float(image.skin[image.seen].mean()))
    # What is alike all over has nothing that tells it from skin.
    assert min(shares) > 0.8
    return f"skin: {shares[0]:.0%}, {shares[1]:.0%} and {shares[2]:.0%} of the seen texels"


@CASES.extreme(STAGE, "uv moved by 1, -5 and 1e6 whole periods")
def _() -> str:
    scan = person().scan
    assert scan.uv is not None
    gaps = [colour_gap(sampled(replace(scan, uv=scan.uv + shift))) for shift in (1.0, -5.0, 1e6)]
    assert max(gaps) < 2e-3
    return f"colours {max(gaps):.0e} apart"


@CASES.extreme(STAGE, "uv that span a million periods", "measured warning")
def _() -> str:
    scan = person().scan
    assert scan.uv is not None
    share = sampled(replace(scan, uv=1e6 * scan.uv)).figures()["seen"]
    assert share < 0.3
    return Measured(f"seen: {share:.0%} of the texels")


@CASES.extreme(STAGE, "uv of 1e300", "named error")
def _() -> str:
    scan = person().scan
    assert scan.uv is not None
    with naming("a texture coordinate is .*, beyond 1e\\+12", "leave uv out"):
        sampled(replace(scan, uv=1e300 * scan.uv))
    return "sampled"


@CASES.extreme(STAGE, "uv all in one place", "measured warning")
def _() -> str:
    scan = person().scan
    assert scan.uv is not None
    return unseen(sampled(replace(scan, uv=0 * scan.uv + 0.5)))


@CASES.extreme(STAGE, "NaN uv", "named error")
def _() -> str:
    scan = person().scan
    assert scan.uv is not None
    broken = scan.uv.copy()
    broken[0, 0] = np.nan
    with naming(r"uv holds 2 values that are NaN or infinite, first at \(0, 0, 0\)", "repair or re-export"):
        sampled(replace(scan, uv=broken))
    return "sampled"


@CASES.extreme(STAGE, "textures of 1 x 1, 1 x 10000 and 10000 x 1")
def _() -> str:
    for shape in ((1, 1), (1, 10000), (10000, 1)):
        image = sampled(replace(person().scan, texture_linear=np.full((*shape, 3), 0.3, np.float32)))
        assert image.texture_linear is not None
        np.testing.assert_allclose(image.texture_linear[image.seen], 0.3, atol=1e-3)
    return f"0.3 on the {image.figures()['seen']:.0%} seen"


@CASES.extreme(STAGE, "vertex colours all black")
def _() -> str:
    scan = person().scan
    image = sampled(RawScan(scan.vertices, scan.faces, vertex_color_linear=0 * scan.vertices))
    assert image.texture_linear is not None
    assert not image.texture_linear.any()
    return f"black, {image.figures()['seen']:.0%} seen"


@CASES.extreme(
    STAGE, "a scan that shows nothing of the face: far away, inside out, one triangle", "measured warning"
)
def _() -> str:
    scan = _bare(person().scan)
    triangle = RawScan(scan.vertices[:3], [[0, 1, 2]], vertex_color_linear=np.ones((3, 3)))
    for hidden in (
        replace(scan, vertices=scan.vertices + 1e6),
        replace(scan, faces=scan.faces[:, ::-1].copy()),
        triangle,
    ):
        figure = unseen(sampled(hidden))
    return figure


@CASES.extreme(STAGE, "a chart with a flipped triangle")
def _() -> str:
    uv = face().uv.copy()
    uv[face().faces[100]] = uv[face().faces[100]][[0, 2, 1]]
    image = sampled(person().scan, replace(face(), uv=uv))
    moved = (np.linalg.norm(image.position - plain().position, axis=2) > 0.5).mean()
    assert moved < 0.01
    return f"{moved:.2%} of the texels differ"


@CASES.extreme(STAGE, "a chart outside the unit square", "named error")
def _() -> str:
    with naming(r"chart leaves the unit square at \d+ of", "scale its uv"):
        sampled(person().scan, replace(face(), uv=face().uv + 0.5))
    return "sampled"


@CASES.extreme(STAGE, "a chart of one point", "named error")
def _() -> str:
    with naming("chart covers no texel"):
        sampled(person().scan, replace(face(), uv=0 * face().uv))
    return "sampled"


@CASES.extreme(STAGE, "a fitted face or a chart of NaN", "named error")
def _() -> str:
    with naming(r"has \d+ vertices whose uv are NaN", "check the model"):
        sampled(person().scan, replace(face(), uv=np.nan * face().uv))
    return "sampled"


BALL = trimesh.creation.icosphere(3, 100.0)
FREE = "geometry_image (no model)"


def charted(vertices: ArrayLike, faces: ArrayLike, size: int = SIZE) -> tuple[GeometryImage, float]:
    """Sample any surface, and return the part of its area that the texels show, too."""
    scan = RawScan(np.asarray(vertices, float), np.asarray(faces))
    image = geometry_image_of_scan(scan, size)
    _see_sound(image)
    return image, float(image.texel_areas_mm2().sum() / face_areas(scan.vertices, scan.faces).sum())


def on_ball(vertices: ArrayLike, faces: ArrayLike, radius: float = 100.0) -> str:
    """Return the figure of a ball whose texels must lie on it."""
    image, area = charted(vertices, faces)
    off = np.abs(np.linalg.norm(image.position[image.mask], axis=1) / radius - 1).max()
    assert off < 0.02
    assert area > 0.75
    return f"{off:.1%} off the ball, {area:.0%} of its area"


@CASES.extreme(FREE, "sizes of 8 and 512")
def _() -> str:
    charted(BALL.vertices, BALL.faces, 8)
    _, area = charted(BALL.vertices, BALL.faces, 512)
    assert area > 0.95
    return f"{area:.0%} of the ball's area at 512"


@CASES.extreme(FREE, "offset 1e6, 1e7 and 1e9 mm")
def _() -> str:
    for distance in (1e6, 1e7, 1e9):
        figure = on_ball(BALL.vertices + distance, BALL.faces)
    return figure


@CASES.extreme(FREE, "sizes of 1e-4 mm to 1e14 mm")
def _() -> str:
    for factor in (1e-6, 1e-3, 1e6, 1e12):
        figure = on_ball(BALL.vertices * factor, BALL.faces, 100 * factor)
    return figure


@CASES.extreme(FREE, "mixed orientation; every face twice; zero-area faces; inside out")
def _() -> str:
    mixed = np.where((np.arange(len(BALL.faces)) % 3 == 0)[:, None], BALL.faces, BALL.faces[:, ::-1])
    flat = np.concatenate([BALL.faces, BALL.faces[:90, [0, 0, 1]]])
    for faces in (mixed, flat, BALL.faces[:, ::-1]):
        figure = on_ball(BALL.vertices, faces)
    _, area = charted(BALL.vertices, np.concatenate([BALL.faces, BALL.faces]))
    assert area > 0.35, "of both copies' area"
    return figure


@CASES.extreme(FREE, "a single triangle; a plane; slivers of aspect 1e6")
def _() -> str:
    corners = np.array([[0.0, 0, 0], [100, 0, 0], [50, 1e-4, 0], [50, 80, 0]])
    areas = [
        charted(corners[[0, 1, 3]], [[0, 1, 2]])[1],
        charted(corners, [[0, 1, 2], [2, 1, 3], [0, 2, 3]])[1],
    ]
    assert min(areas) > 0.8
    return f"{areas[0]:.0%} and {areas[1]:.0%} of the area"


@CASES.extreme(FREE, "a line of points", "named error")
def _() -> str:
    points = np.column_stack([np.arange(30.0), np.zeros((30, 2))])
    with naming("every face has zero area"):
        charted(points, np.arange(30).reshape(-1, 3))
    return "charted"


@CASES.extreme(FREE, "one vertex at 1e11 mm", "named error")
def _() -> str:
    vertices = np.array(BALL.vertices)
    vertices[0] *= 1e9
    with naming("no chart that covers a texel", "remove vertices that lie far"):
        charted(vertices, BALL.faces)
    return "charted"


@CASES.extreme(FREE, "a head of 32,000 faces, pinched and in pieces", slow=True)
def _() -> str:
    image = geometry_image_of_scan(person().scan, 96)
    _see_sound(image)
    total = face_areas(person().scan.vertices, person().scan.faces).sum()
    area = float(image.texel_areas_mm2().sum() / total)
    assert area > 0.4
    return f"{area:.0%} of its area, {image.figures()['seen']:.0%} of the texels seen"


@CASES.extreme(FREE, "2000 loose triangles", "measured warning")
def _() -> str:
    rng = np.random.default_rng(0)
    soup = rng.uniform(0, 200, (2000, 1, 3)) + rng.normal(0, 3, (2000, 3, 3))
    image, area = charted(soup.reshape(-1, 3), np.arange(6000).reshape(-1, 3))
    assert area < 0.1
    return Measured(f"coverage {image.figures()['coverage']:.0%}: gaps between charts take the rest")
