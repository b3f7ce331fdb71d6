"""The scan without its light, at its own texels, beside the chart; and colours on other people's templates.

usage: python tools/bench_unlit.py [traced] [rim] [templates] [normals] [peers PYTHON]

traced     path-traced raw scans with the true albedo on their own coordinates: relative RMSE of V =
           max(R, G, B) after the best single scale, what half of the texels and 95 in 100 err by at most, and
           100 x MSE, of the lit scan, of the chart's albedo and of the unlit scan's own texels on the face,
           and of the lit and the unlit scan beyond it.
rim        path-traced raw scans with a person's skin and hair: by how much log colour of skin steps across
           the face's rim more than the true albedo does, RMS over the rim, of the lit and both unlit scans;
           relative RMSE of all that lies beyond the face; and which part of it is called hair and is, or not.
templates  a real scan, its colours on the texture coordinates of a mask of 468 vertices and of a head: PSNR
           of the template's picture against the scan's, same camera, where the scan shows the template.
normals    synthetic scans, coarse and fine: mean angle in degrees to the true normals, where the scan shows
           it, of a mask of 468 vertices by itself, the fitted surface, the scan, and the mask's normal map.
peers      the same wish on the mask as others do it: trimesh's `nricp_amberg`, started from our pose, and
           some thirty lines that lay the colours on its coordinates (`benchmarks/fit_peers.py`);
           autofacemonker, whose own template has no coordinates, with colours at its vertices. PYTHON has
           trimesh, rtree and autofacemonker. None of them takes the light off.

The scans are not part of the repository (see `worlds/files.py`).
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench.judging import score
from bench_fit import run_peer
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from worlds.files import DATA, face_data

import scan2albedo as s2a
from scan2albedo.applications.light_removal import scan_on_chart, unlit_scan
from scan2albedo.applications.template_baking import FineShape, TemplateTexture, template_texture
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.mesh import boundary_loops, face_areas, normalized, vertex_normals
from scan2albedo.geometry.rasterization import bilinear, interpolate, pixels_from_uv, rasterize, rasterize_uv
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.geometry.tangents import tangent_mesh
from scan2albedo.io.color import encode_srgb_bytes, srgb_to_linear
from scan2albedo.io.images import read_image_linear
from scan2albedo.rendering.pictures import View, render_mesh
from scan2albedo.synthetic import Scanner, SyntheticTruth, raw_scan

LEAST_LIGHT = 0.03
"""Texels that got less of the usual light do not count: there is no colour in them."""
INSIDE = 0.99
"""Weight of the face above which a texel counts as the face, and below 1 less which it does not."""
SKIN = 0.5
"""Log albedo of skin deviates less than this from the face's; hair is darker by more than twice as much."""
HALF_WIDTH_MM, SIZE, SAMPLES = 110.0, 900, 3
"""Of the pictures, and rays along each side of a pixel."""
PEERS_SIZE = 1024


def main(what: tuple[str, ...]) -> None:
    """Run the parts that are named, or all but the peers."""
    if what[:1] == ("peers",):
        print_peers(*what[1:])
        return
    parts = {"traced": print_traced, "rim": print_rim, "templates": print_templates, "normals": print_normals}
    for part in what or tuple(parts):
        parts[part]()


def errors(found: NDArray[np.floating], true: NDArray[np.floating]) -> str:
    """Return relative RMSE, 50 %, 95 % and 100 x MSE of V of texels (N, 3) as text."""
    pair = (np.asarray(each, float)[None] for each in (found, true))
    of = score(*pair, np.ones((1, len(true)), bool))
    return f"{of.rmse:7.1f}{of.half:6.1f}{of.most:6.1f}{of.mse:7.2f}"


def print_traced() -> None:
    """Print errors at the chart's and at the scan's own texels."""
    parts = ("face: lit", "chart", "own texels", "beyond: lit", "all")
    print("RMSE, 50, 95 %, MSE".ljust(22) + "".join(f"{part:28}" for part in parts) + "CPU s")
    for file in sorted((DATA / "traced").glob("p*.obj")):
        result = s2a.process(file)
        scan, fitted, estimate = result.scan, result.fitted, result.albedo
        assert fitted is not None
        assert estimate is not None
        assert scan.texture_linear is not None
        assert scan.uv is not None
        begin = time.process_time()
        face = unlit_scan(scan, fitted, estimate).scan.texture_linear
        cpu_s = time.process_time() - begin
        everywhere = unlit_scan(scan, fitted, estimate, "all").scan.texture_linear
        assert face is not None
        assert everywhere is not None
        shape = scan.texture_linear.shape[:2]
        picture = read_image_linear(file.with_name(f"{file.stem}_albedo.png"))
        true = cv2.resize(picture, shape[::-1], interpolation=cv2.INTER_LINEAR)
        corners = pixels_from_uv(scan.uv.reshape(-1, 2), shape)
        index = np.arange(len(corners)).reshape(-1, 3)
        raster = rasterize(corners, np.zeros(len(corners)), index, shape)
        own = scan_on_chart(scan, fitted, estimate.image)[1]
        weight = interpolate(raster, index, own[scan.faces].reshape(-1, 1))[..., 0]
        light = scan.texture_linear.max(-1) / np.maximum(true.max(-1), 1e-3)
        lit = (
            raster.covered & (true.min(-1) > 0.01) & (light > LEAST_LIGHT * np.median(light[weight > INSIDE]))
        )
        inside, beyond = lit & (weight > INSIDE), lit & (weight < 1 - INSIDE)
        row = [
            errors(scan.texture_linear[inside], true[inside]),
            _chart_error(result, true, own),
            errors(face[inside], true[inside]),
            errors(scan.texture_linear[beyond], true[beyond]),
            errors(everywhere[beyond], true[beyond]),
        ]
        print(f"{file.stem:16}" + " |".join(row) + f" |{cpu_s:6.1f}", flush=True)


def _chart_error(result: s2a.ProcessResult, true: NDArray[np.floating], weight: NDArray[np.floating]) -> str:
    """Return the errors of the chart's albedo at its own texels, on the same part of the face."""
    scan, fitted, estimate = result.scan, result.fitted, result.albedo
    assert fitted is not None
    assert estimate is not None
    assert scan.uv is not None
    image = estimate.image
    assert image.texture_linear is not None
    points = transform_points(invert_rigid(fitted.model_from_scan), image.position[image.mask])
    hits = ClosestPointQuery(scan.vertices, scan.faces).query(points)
    uv = np.einsum("nk,nkc->nc", hits.barycentric, scan.uv[hits.face])
    wanted = bilinear(true, pixels_from_uv(uv, true.shape[:2]))
    inside = np.einsum("nk,nk->n", hits.barycentric, weight[scan.faces[hits.face]]) > INSIDE
    light = image.texture_linear[image.mask].max(-1) / np.maximum(wanted.max(-1), 1e-3)
    counted = inside & image.seen[image.mask] & (wanted.min(-1) > 0.01)
    counted &= light > LEAST_LIGHT * np.median(light[counted])
    return errors(estimate.albedo_linear[image.mask][counted], wanted[counted])


def print_rim() -> None:
    """Print steps of colour across the face's rim, errors beyond it, and what is found as hair."""
    print(" " * 18 + "step: lit   face    all    RMSE: lit  face   all    hair   not")
    for file in sorted((DATA / "real_skin").glob("*.obj")):
        result = s2a.process(file)
        scan, fitted, estimate = result.scan, result.fitted, result.albedo
        assert fitted is not None
        assert estimate is not None
        assert scan.texture_linear is not None
        assert scan.uv is not None
        everywhere = unlit_scan(scan, fitted, estimate, "all")
        of_face = unlit_scan(scan, fitted, estimate).scan.texture_linear
        shown = scan.texture_linear, of_face, everywhere.scan.texture_linear
        shape = scan.texture_linear.shape[:2]
        picture = read_image_linear(file.with_name(f"{file.stem}_albedo.png"))
        true = cv2.resize(picture, shape[::-1], interpolation=cv2.INTER_LINEAR)
        corners = pixels_from_uv(scan.uv.reshape(-1, 2), shape)
        index = np.arange(len(corners)).reshape(-1, 3)
        raster = rasterize(corners, np.zeros(len(corners)), index, shape)
        placed = transform_points(fitted.model_from_scan, scan.vertices)[scan.faces].reshape(-1, 3)
        own = scan_on_chart(scan, fitted, estimate.image)[1][scan.faces].reshape(-1, 1)
        light = scan.texture_linear.max(-1) / np.maximum(true.max(-1), 1e-3)
        weight = interpolate(raster, index, own)[..., 0]
        lit = (
            raster.covered & (true.min(-1) > 0.01) & (light > LEAST_LIGHT * np.median(light[weight > INSIDE]))
        )
        beyond, log_true = lit & (weight < 1 - INSIDE), np.log(np.maximum(true, 1e-3))
        skin = np.abs(log_true - np.median(log_true[lit & (weight > INSIDE)], axis=0)).max(-1) < SKIN
        place = interpolate(raster, index, placed)[lit & skin]
        steps = [
            _step(fitted, place, (np.log(np.maximum(one, 1e-4)) - log_true)[lit & skin]) for one in shown
        ]
        errs = [errors(one[beyond], true[beyond])[:7] for one in shown]
        hair = np.zeros(shape) if everywhere.hair is None else everywhere.hair
        dark = log_true.max(-1) < np.median(log_true[lit & (weight > INSIDE)], axis=0).max() - 2 * SKIN
        found = [
            (hair[beyond & part] > 0.5).mean() if (beyond & part).any() else np.nan for part in (dark, skin)
        ]
        print(
            f"{file.stem:16}" + "".join(f"{step:{10 if k == 0 else 7}.2f}" for k, step in enumerate(steps))
            + "     " + "".join(errs) + f"{found[0]:8.0%}{found[1]:6.0%}", flush=True
        )  # fmt: skip


def _step(fitted: s2a.FittedFace, place: NDArray[np.floating], value: NDArray[np.floating]) -> float:
    """Return the RMS over the face's rim of the step of values (N, 3) at places (N, 3) of skin across it.

    Medians within 15 mm of a point of the rim: beyond it, and of what lies 10 to 20 mm inside of it.
    """
    rim = max(boundary_loops(fitted.faces), key=len)
    inner = np.ones((len(fitted.vertices), 1))
    inner[rim] = 0
    hits = ClosestPointQuery(fitted.vertices, fitted.faces).query(place)
    off = cKDTree(fitted.vertices[rim]).query(place)[0]
    out = (hits.interpolated(inner, fitted.faces)[:, 0] < 0.02) & (off < 10)
    inside = ~out & (hits.distance < 3) & (off > 10) & (off < 20)
    trees, steps = [cKDTree(place[part]) for part in (inside, out)], []
    for point in fitted.vertices[rim[:: max(1, len(rim) // 60)]]:
        near = [tree.query_ball_point(point, reach) for tree, reach in zip(trees, (20, 15), strict=True)]
        if min(map(len, near)) > 30:
            steps.append(np.median(value[out][near[1]], axis=0) - np.median(value[inside][near[0]], axis=0))
    return float(np.sqrt(np.mean(np.square(steps)))) if steps else float("nan")


def print_templates() -> None:
    """Print how well templates with baked textures look like the scan."""
    scan = s2a.load_scan(face_data("james.obj"))
    people = np.load(face_data("ict_faces.npz"))
    mask = s2a.AnnotatedFaceModel.from_file(face_data("canonical_face_model.obj"))
    head = s2a.AnnotatedFaceModel.from_mesh(
        people["shape_generic_neutral"],
        people["faces"],
        people["uv"][people["uv_faces"]],
        control_size=2500,
        name="head",
    )
    print(f"{'':12}{'texels':>8}{'tiles':>7}{'seen':>7}{'PSNR dB':>9}{'within 0.3 mm':>15}{'CPU s':>7}")
    for name, model in (("mask", mask), ("head", head)):
        fitted = s2a.fit(scan, model, s2a.register(scan, model))
        placed = transform_points(fitted.model_from_scan, scan.vertices)
        for size in (1024, 2048):
            begin = time.process_time()
            painted = template_texture(scan, fitted, size)
            cpu_s = time.process_time() - begin
            close = ClosestPointQuery(placed, scan.faces).query(painted.vertices).distance < 0.3
            both = (
                _psnr(painted, scan, placed, np.ones(len(close), bool)),
                _psnr(painted, scan, placed, close),
            )
            seen = np.mean([tile.seen.mean() for tile in painted.tiles])
            print(
                f"{name:12}{size:8}{len(painted.tiles):7}{seen:7.0%}{both[0]:9.1f}{both[1]:15.1f}{cpu_s:7.1f}"
            )


def print_peers(python: str) -> None:
    """Print seconds and likeness of a template with a scan's colours, by ways that others offer."""
    scan = s2a.load_scan(face_data("james.obj"))
    assert scan.uv is not None
    assert scan.texture_linear is not None
    print(f"{'':34}{'programs to write':>19}{'CPU s':>7}{'PSNR dB':>9}")
    begin = time.process_time()
    mask = s2a.AnnotatedFaceModel.from_file(face_data("canonical_face_model.obj"))
    fitted = s2a.fit(scan, mask, s2a.register(scan, mask))
    painted = template_texture(scan, fitted, PEERS_SIZE)
    cpu_s = time.process_time() - begin
    placed = transform_points(fitted.model_from_scan, scan.vertices)
    everything = np.ones(len(painted.vertices), bool)
    _print_peer("scan2albedo process --model", "none", cpu_s, _psnr(painted, scan, placed, everything))
    at_rest = mask.template_of(mask.control_vertices)
    assert at_rest is not None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        given = {"scan_vertices": placed, "scan_faces": scan.faces, "faces": painted.faces}
        np.savez(folder / "in.npz", vertices=at_rest, **given)
        if run_peer(python, "nricp_amberg", folder / "in.npz", folder / "moved.npz"):
            moved = np.load(folder / "moved.npz")
            texture = encode_srgb_bytes(scan.texture_linear)
            given |= {"uv": painted.uv, "scan_uv": scan.uv, "texture": texture, "size": np.array(PEERS_SIZE)}
            np.savez(folder / "in.npz", vertices=moved["vertices"], **given)
            if run_peer(python, "bake", folder / "in.npz", folder / "baked.npz"):
                baked = np.load(folder / "baked.npz")
                color = srgb_to_linear(baked["color_srgb"] / 255).astype(np.float32)
                tile = replace(painted.tiles[0], color_linear=color)
                other = replace(painted, vertices=moved["vertices"], tiles=(tile,))
                spent = float(moved["cpu_s"] + baked["cpu_s"])
                both = _psnr(other, scan, placed, everything)
                _print_peer("trimesh nricp_amberg and a bake", "pose, bake", spent, both)
        if run_peer(python, "autofacemonker", face_data("james.obj"), folder / "warped.npz"):
            warped = np.load(folder / "warped.npz")
            begin = time.process_time()
            query = ClosestPointQuery(scan.vertices, scan.faces).query(warped["vertices"])
            uv = np.einsum("nk,nkc->nc", query.barycentric, scan.uv[query.face])
            shape = scan.texture_linear.shape[:2]
            colors = bilinear(scan.texture_linear, pixels_from_uv(uv, shape))
            spent = float(warped["cpu_s"]) + time.process_time() - begin
            upright = transform_points(fitted.model_from_scan, warped["vertices"])
            shown = _drawn(
                upright, warped["faces"], vertex_color_srgb=encode_srgb_bytes(colors[None])[0] / 255
            )
            counted = (
                _drawn(upright, warped["faces"], vertex_color_srgb=np.zeros((len(upright), 3))).max(-1) == 0
            )
            likeness = _likeness(shown, scan, placed, counted)
            _print_peer("autofacemonker, colours at vertices", "colours", spent, likeness)


def _print_peer(name: str, by_hand: str, cpu_s: float, psnr_db: float) -> None:
    print(f"{name:36}{by_hand:>17}{cpu_s:7.1f}{psnr_db:9.1f}", flush=True)


def print_normals() -> None:
    """Print how far normals are from the truth's, with and without the template's normal map."""
    mask = s2a.AnnotatedFaceModel.from_file(face_data("canonical_face_model.obj"))
    print(f"{'spacing':>9}{'noise mm':>10}{'seed':>6}{'mask':>7}{'fit':>7}{'scan':>7}{'map':>7}{'CPU s':>7}")
    for spacing_mm, noise_mm in ((2.2, 0.2), (1.0, 0.05), (0.8, 0.15)):
        for seed in range(2):
            scanner = Scanner(spacing_mm=spacing_mm, noise_mm=noise_mm, picture_size=400)
            scan, truth = raw_scan(seed, scanner=scanner)
            fitted = s2a.fit(scan, mask, s2a.register(scan, mask))
            angles, cpu_s = _angles_deg(scan, fitted, truth)
            row = "".join(f"{angle:7.2f}" for angle in angles)
            print(f"{spacing_mm:9}{noise_mm:10}{seed:6}{row}{cpu_s:7.1f}", flush=True)


def _angles_deg(
    scan: s2a.RawScan, fitted: s2a.FittedFace, truth: SyntheticTruth
) -> tuple[list[float], float]:
    """Return mean angles to the true normals of template, fit, scan and map, and the map's CPU seconds."""
    painted = template_texture(scan, fitted, 1024)
    (tile,) = painted.tiles
    frames = tangent_mesh(
        painted.vertices, painted.faces, painted.uv, vertex_normals(painted.vertices, painted.faces)
    )
    raster = rasterize_uv(frames.split.uv, frames.split.faces, 1024)
    known = tile.seen & raster.covered
    place, flat, tangent = (
        interpolate(raster, frames.split.faces, values)[known]
        for values in (painted.vertices[frames.split.vertex], frames.normals, frames.tangents)
    )
    flat, right = normalized(flat), normalized(tangent[:, :3])
    up = tangent[:, 3:] * np.cross(flat, right)
    x, y, z = tile.normal[known].astype(float).T[..., None]
    truth_from_model = truth.model_from_scan @ invert_rigid(fitted.model_from_scan)
    inside = truth.image.mask
    gap, nearest = cKDTree(truth.image.position[inside]).query(transform_points(truth_from_model, place))
    true = truth.image.normal[inside][nearest] @ truth_from_model[:3, :3]
    begin = time.process_time()
    FineShape(fitted, scan)
    cpu_s = time.process_time() - begin
    placed = transform_points(fitted.model_from_scan, scan.vertices)
    hits, own = ClosestPointQuery(placed, scan.faces).query(place), vertex_normals(placed, scan.faces)
    raw = normalized(np.einsum("nk,nkc->nc", hits.barycentric, own[scan.faces[hits.face]]))
    fit = FineShape(fitted, None).normals(place)[0]
    close = gap < 1.5  # mm: the truth ends before the template does
    area = face_areas(painted.vertices, frames.split.vertex[frames.split.faces])
    texels = np.bincount(raster.face[known], minlength=len(area))
    weight = (area / np.maximum(texels, 1))[raster.face[known]] * close
    found = flat, fit, raw, normalized(x * right + y * up + z * flat)
    angle = [np.arccos(np.clip(np.einsum("ij,ij->i", normal, true), -1, 1)) for normal in found]
    return [float(np.degrees(np.average(each, weights=weight))) for each in angle], cpu_s


def _psnr(
    painted: TemplateTexture, scan: s2a.RawScan, placed: NDArray[np.floating], chosen: NDArray[np.bool_]
) -> float:
    """Return the PSNR of the first tile's faces with all their vertices `chosen` (T,), in dB."""
    tile = painted.tiles[0]
    faces = tile.faces & chosen[painted.faces].all(1)
    template, uv = (painted.vertices, painted.faces[faces]), painted.uv[faces]
    unseen = np.repeat(np.where(tile.seen[..., None], 0, 255).astype(np.uint8), 3, axis=2)
    counted = _drawn(*template, texture_srgb=(uv, unseen)).max(-1) == 0  # wholly on the template, and seen
    shown = _drawn(*template, texture_srgb=(uv, encode_srgb_bytes(tile.color_linear)))
    return _likeness(shown, scan, placed, counted)


def _likeness(
    shown: NDArray[np.floating],
    scan: s2a.RawScan,
    placed: NDArray[np.floating],
    counted: NDArray[np.bool_],
) -> float:
    """Return the PSNR of a picture beside that of the scan whose vertices are `placed`, in dB."""
    assert scan.uv is not None
    assert scan.texture_linear is not None
    texture = (scan.uv, encode_srgb_bytes(scan.texture_linear))
    difference = shown - _drawn(placed, scan.faces, texture_srgb=texture)
    return float(10 * np.log10(255**2 / np.mean(difference[counted] ** 2)))


def _drawn(vertices: NDArray[np.floating], faces: NDArray[np.integer], **colors: Any) -> NDArray[np.float32]:
    """Return a picture (S, S, 3) from the front of a mesh without shading, in bytes of sRGB."""
    view = View((0.0, 0.0, 0.0), HALF_WIDTH_MM)
    picture = render_mesh(vertices, faces, view=view, size=SAMPLES * SIZE, shaded=False, **colors)
    return cv2.resize(picture.astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_AREA)


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        main(tuple(sys.argv[1:]))
