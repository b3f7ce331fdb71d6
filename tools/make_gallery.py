"""The pictures of docs/gallery.md, or the same of a scan of yours.

    python tools/make_gallery.py [-o docs/images/gallery]
    python tools/make_gallery.py --scan SCAN -o FOLDER

Without SCAN everything is made by the package: its synthetic people, a linear model of them, synthetic
eyeglasses and the examples; two minutes of CPU. README's picture, before_after.jpg, comes to lie beside the
folder. With it: what became of the scan (scan.jpg), the scan beside itself without its light (unlit.jpg), and
the maps of a skin material (maps.jpg).
"""

import argparse
import runpy
import tempfile
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from matplotlib import font_manager
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.special import expit

import scan2albedo as s2a
from scan2albedo.core.arrays import FloatArray, IntArray
from scan2albedo.eyeglasses import KEY_POINT_NAMES, propose_keypoints
from scan2albedo.face_model import default_model
from scan2albedo.face_model.variation import EXPRESSION_BUMPS, displacement, identity_modes
from scan2albedo.geometry.mesh import join
from scan2albedo.geometry.pinhole import look_at
from scan2albedo.geometry.rasterization import bilinear, pixels_from_uv
from scan2albedo.geometry.rigid import transform_points
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.pipeline.result import ProcessResult
from scan2albedo.rendering.pictures import DISTANCE_MM, View, auto_exposure, heat_colors, render_mesh
from scan2albedo.report.eyeglasses_views import key_point_chart
from scan2albedo.report.overview import preview_srgb
from scan2albedo.synthetic import GlassesBend, Scanner, eyeglasses
from scan2albedo.unlit.template_baking import integers, normal_bytes

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "images" / "gallery"
HEIGHT = 224
"""Of the panels in pixels."""
GAP = 8
"""Between them."""
CAPTION = 30
"""Height of a caption in pixels."""
FONT_SIZE = 18
FINER = 3
"""Samples along a side of a pixel."""
NARROW = 0.72
"""Width over height of panels with a face from the front."""
TILT_DEG = 50.0
FLASH = s2a.PointLight(np.deg2rad(-48), np.deg2rad(22), distance_mm=900.0, intensity=3.5)
LAMPS = (
    s2a.PointLight(np.deg2rad(62), np.deg2rad(12), intensity=4.0),
    s2a.PointLight(np.deg2rad(-25), np.deg2rad(48), intensity=4.0),
)
QUALITY = 86
SIDE_DEG = 40.0
"""Of the second view of a scan."""
SEED = 6
LAMP = s2a.PointLight(np.deg2rad(20), np.deg2rad(10), intensity=2.0)
"""In front of eyes, where neither brow nor nose shades them."""
EYES_MM = 108.0
"""Width of the picture of both eyes."""
MOUTH_MM = 62.0
"""Width of the picture of a mouth."""
MOUTH_PITCH_DEG = 12.0
"""How far the mouth is seen from below."""
JAW_MM = np.array([0.0, -17.0, -6.0])
"""How far chin and lower lip move as the jaw opens."""
Pixels = NDArray[np.uint8]
Panels = list[tuple[str, Pixels]]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("-o", "--out", type=Path, default=OUT)
    parser.add_argument("--scan", type=Path)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    linear_model = None
    if given.scan is not None:
        scan = s2a.load_scan(given.scan)
    else:
        scanner = Scanner(rotation_max_deg=TILT_DEG)
        scan, _ = s2a.synthetic.raw_scan(SEED, lights=[FLASH], scanner=scanner)
    with tempfile.TemporaryDirectory() as name:
        if given.scan is None:
            linear_model = Path(name) / "people.npz"
            write_linear_model(linear_model)
        size = 2 * HEIGHT
        result = s2a.process(
            scan, unlit="all", maps="chart", texture_size=size, seed=0, linear_model=linear_model
        )
        pictures = {"scan": panels(result), "unlit": unlit_panels(result), "maps": maps_panels(result)}
        if given.scan is None:
            pictures["../before_after"] = pictures.pop("scan")
            pictures["eyes_and_mouth"] = [*eyes_panels(result), mouth_panel(result)]
            pictures["blendshapes"] = linear_model_panels(result)
            pictures |= example_panels(Path(name))
            save(given.out / "key_points.jpg", key_points_picture())
    for name, made in pictures.items():
        save(given.out / f"{name}.jpg", sheet(made))


def save(file: Path, picture: Image.Image) -> None:
    picture.save(file, quality=QUALITY, optimize=True)
    print(f"{file}: {file.stat().st_size / 1000:.0f} kB")


def panels(result: ProcessResult) -> Panels:
    """Return titles and pictures from the raw scan to the relit face."""
    image, estimate = result.geometry_image, result.albedo
    return [
        ("raw scan", raw_panel(result.scan)),
        ("fitted", fitted_panel(result)),
        ("texture as scanned", smaller(preview_srgb(image.texture_linear, image.mask))),
        ("albedo", smaller(preview_srgb(estimate.albedo_linear, image.mask))),
        *((f"relit {where}", pixels) for where, pixels in relit_panels(result)),
    ]


def raw_panel(scan: s2a.RawScan) -> Pixels:
    """Return the scan as it was delivered: its own pose, hair, shoulders, holes and crumbs."""
    low, high = np.percentile(scan.vertices, [0.5, 99.5], axis=0)
    x, y, z = (low + high) / 2
    return scan_picture(scan, scan.vertices, View((x, y, z), 0.54 * float((high - low)[:2].max())))


def scan_picture(scan: s2a.RawScan, vertices: NDArray[np.floating], view: View) -> Pixels:
    """Return a scan's own colours, whose vertices (V, 3) were turned, without any shading."""
    looks: dict[str, Any] = {}
    if scan.uv is not None and scan.texture_linear is not None:
        looks["texture"] = scan.uv, scan.texture_linear
    else:
        looks["vertex_color_srgb"] = encode_srgb_bytes(scan.vertex_color_linear[None])[0] / 255
    return rendered(vertices, scan.faces, view=view, shaded=False, **looks)


def rendered(vertices: FloatArray, faces: IntArray, **looks: Any) -> Pixels:
    """Return a mesh as `render_mesh` draws it, averaged to a panel's size."""
    return smaller(render_mesh(vertices, faces, size=FINER * HEIGHT, **looks))


def fitted_panel(result: ProcessResult) -> Pixels:
    """Return the fitted surface in grey with its landmarks."""
    fitted = result.fitted
    around = View.around(fitted.vertices)
    size = FINER * HEIGHT
    picture = Image.fromarray(render_mesh(fitted.vertices, fitted.faces, view=around, size=size))
    scale = (size - 1) / (2 * around.half_width_mm)
    draw = ImageDraw.Draw(picture)
    for right, up, _ in around.project(fitted.landmarks):
        column, row = (right + around.half_width_mm) * scale, (around.half_width_mm - up) * scale
        draw.ellipse((column - 4, row - 4, column + 4, row + 4), fill=(214, 72, 30))
    return narrow(smaller(np.asarray(picture)))


def relit_panels(result: ProcessResult) -> Panels:
    """Return the face under two new lamps, on white."""
    face = s2a.applications.load_result(result)
    made = []
    for name, lamp in zip(("sideways", "from above"), LAMPS, strict=True):
        lit = s2a.applications.relight(face, [lamp], ambient=0.35)
        picture = lit.picture(shape=(HEIGHT, HEIGHT), samples=FINER)
        alpha = picture.alpha[..., None]
        on_white = alpha * picture.srgb() + 255 * (1 - alpha)
        made.append((name, narrow(np.round(on_white).astype(np.uint8))))
    return made


def smaller(picture: NDArray[np.generic]) -> Pixels:
    """Return a square picture at a panel's size, averaged."""
    resized = Image.fromarray(np.asarray(picture, np.uint8)).resize((HEIGHT, HEIGHT), Image.Resampling.BOX)
    return np.asarray(resized)


def narrow(picture: Pixels) -> Pixels:
    """Return the middle columns."""
    width = round(NARROW * picture.shape[1])
    first = (picture.shape[1] - width) // 2
    return picture[:, first : first + width]


def sheet(pictures: Panels) -> Image.Image:
    """Return the panels side by side on white, each with its caption below."""
    width = GAP + sum(pixels.shape[1] + GAP for _, pixels in pictures)
    page = Image.new("RGB", (width, HEIGHT + CAPTION + 2 * GAP), "white")
    draw = ImageDraw.Draw(page)
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), FONT_SIZE)
    left = GAP
    for title, pixels in pictures:
        page.paste(Image.fromarray(pixels), (left, GAP))
        middle = (left + pixels.shape[1] // 2, GAP + HEIGHT + CAPTION // 2)
        draw.text(middle, title, fill=(60, 60, 60), font=font, anchor="mm")
        left += pixels.shape[1] + GAP
    return page


def unlit_panels(result: ProcessResult) -> Panels:
    """Return a scan and the same without its light, from the front and from a side, by the same camera."""
    face = View.around(result.fitted.vertices)
    made = []
    for where, yaw_deg in (("from the front", 0.0), ("from the side", SIDE_DEG)):
        view = View(face.center_mm, 1.4 * face.half_width_mm, yaw_deg)
        for what, scan in (("scan", result.scan), ("unlit", result.unlit.scan)):
            upright = transform_points(result.fitted.model_from_scan, scan.vertices)
            made.append((f"{what}, {where}", scan_picture(scan, upright, view)))
    return made


def maps_panels(result: ProcessResult) -> Panels:
    """Return the maps of a skin material on the face's chart."""
    (tile,) = result.maps_of_skin.tiles
    shown = {"albedo": encode_srgb_bytes(tile.color_linear), "normals": normal_bytes(tile.normal)}
    grey = {**tile.maps, "displacement": 0.5 + tile.maps["displacement_mm"] / 2}  # 1 mm outward is white
    for name in ("displacement", "cavity", "occlusion", "specular"):
        shown[name] = np.repeat(integers(grey[name])[..., None], 3, axis=-1)
    return [(name, smaller(pixels)) for name, pixels in shown.items()]


def eyes_panels(result: ProcessResult) -> Panels:
    """Return a pair of eyes as a texture, and as eyeballs behind the lids, from the front and from a side."""
    face = s2a.applications.load_result(result)
    relit = s2a.applications.relight(face, [LAMP], ambient=0.6)
    painted = replace(relit, face=replace(relit.face))
    middle, shape, made = face.landmarks[36:48].mean(0), (HEIGHT, 2 * HEIGHT - GAP), []
    for title, shown, yaw_deg in (
        ("the eyes in the texture", painted, 0.0),
        ("eyeballs behind the lids", relit, 0.0),
        ("and from the side", relit, 0.7 * SIDE_DEG),
    ):
        toward = s2a.PointLight(np.deg2rad(yaw_deg), 0.0).direction
        focal_px = DISTANCE_MM * shape[1] / EYES_MM
        camera = look_at(middle + DISTANCE_MM * toward, middle, focal_px=focal_px, shape=shape)
        made.append((title, shown.picture(camera, shape=shape, samples=FINER).srgb()))
    return made


def mouth_panel(result: ProcessResult) -> tuple[str, Pixels]:
    """Return the mouth, its jaw opened by a blendshape."""
    targets = result.linear_model.neutral_and_targets()[1]
    x, y, z = result.template.vertices[result.template.landmarks[48:68]].mean(0) + JAW_MM / 2
    view = View((x, y, z), MOUTH_MM / 2, pitch_deg=MOUTH_PITCH_DEG)
    return "a mouth opened", template_picture(result, targets["jawOpen"], view)


def linear_model_panels(result: ProcessResult) -> Panels:
    """Return a scan, the linear model on it, what that leaves, and blendshapes of this person."""
    fit, fitted = result.linear_model, result.fitted
    targets = fit.neutral_and_targets()[1]
    view = View.around(np.concatenate([fit.vertices, fit.vertices + targets["jawOpen"]]))
    upright = transform_points(fitted.model_from_scan, result.scan.vertices)
    mesh = fit.vertices, fit.model.faces
    left = heat_colors(fit.residual_mm, 0, 1)
    made = [
        ("a scan", scan_picture(result.scan, upright, view)),
        ("model on it", rendered(*mesh, view=view)),
        ("0 to 1 mm off", rendered(*mesh, vertex_color_srgb=left, view=view, shaded=False)),
    ]
    for name in ("smile", "mouthPucker", "jawOpen"):
        made.append((name, template_picture(result, targets[name], view)))
    return [(title, narrow(pixels)) for title, pixels in made]


def template_picture(result: ProcessResult, move: FloatArray, view: View) -> Pixels:
    """Return the linear model's mesh at rest with its texture, eyes and mouth, moved by a blendshape."""
    made, fit = result.template, result.linear_model
    (tile,) = made.tiles
    uv = np.zeros((len(made.vertices), 2))
    uv[made.faces] = made.uv
    skin = bilinear(tile.color_linear, pixels_from_uv(uv, tile.seen.shape))
    parts = [(fit.neutral_and_targets()[0] + move, made.faces[~(made.cut_mm[made.faces] > 0).all(1)])]
    colors = [skin]
    for part in made.parts:
        follows = np.zeros((len(part.vertices), 68)) if part.follows is None else part.follows
        parts.append((part.vertices + follows @ move[made.landmarks], part.faces))
        colors.append(np.broadcast_to(part.color_linear, part.vertices.shape))
    bright = np.clip(auto_exposure(skin) * np.concatenate(colors), 0, 1)
    srgb = encode_srgb_bytes(bright[None])[0] / 255
    return rendered(*join(parts), vertex_color_srgb=srgb, view=view)


def write_linear_model(file: Path) -> None:
    """Write a linear model of the synthetic people, with blendshapes, one of which opens the lips."""
    model = default_model()
    rest, marks, fine = model.control_vertices, model.landmarks, model.subdivision(3)
    vertices, region = fine.matrix @ rest, model.region[fine.parent]
    moves = {}
    for name, kind in (("smile", "smile"), ("mouthPucker", "pout"), ("cheekPuff", "puff")):
        moves[name] = fine.matrix @ sum(displacement(bump, rest, marks) for bump in EXPRESSION_BUMPS[kind])
    # How far vertices lie below the line between the lips, mm: the jaw takes them along.
    x, y, _ = vertices.T
    upper, lower = marks[60:65], marks[[60, 67, 66, 65, 64]]
    below = np.interp(x, upper[:, 0], (upper + lower)[:, 1] / 2) - y
    for name, side in (("upper_lip", -1), ("lower_lip", 1)):
        of_lip = np.unique(fine.faces[region == model.regions[name].index])
        below[of_lip] = side * np.maximum(np.abs(below[of_lip]), 1)
    away = np.abs(x) / upper[-1, 0]  # 1 at the corners of the mouth
    share = expit(below / (0.3 + 2 * away**3)) * np.exp(-((away / 2.5) ** 4))
    moves["jawOpen"] = share[:, None] * JAW_MM
    np.savez(
        file,
        mean=vertices,
        basis=np.stack([fine.matrix @ mode for mode in identity_modes(model)], -1),
        faces=fine.faces[region != model.regions["between_lips"].index],
        uv=model.refined_uv(3),
        expression_basis=np.stack(list(moves.values()), -1),
        expression_names=np.array(list(moves)),
    )


def key_points_picture() -> Image.Image:
    """Return the key points proposed for a bent frame, each with its deviation."""
    frame = eyeglasses(SEED, bend=GlassesBend(6.0, 2.0, 3.0))
    found = propose_keypoints((frame.vertices, frame.faces))
    deviations = dict(zip(KEY_POINT_NAMES, found.deviation.tolist(), strict=True))
    mesh = s2a.RawScan(frame.vertices, frame.faces)
    written = BytesIO()
    key_point_chart(mesh, found.points, deviations).savefig(written, format="png", dpi=80)
    with Image.open(written) as picture:
        return picture.convert("RGB")


def example_panels(folder: Path) -> dict[str, Panels]:
    """Run the examples and return what they show."""
    for name in ("relight_sweep", "swap_and_blend", "transfer_expression", "reflectance_from_flashes"):
        arguments = ["-o", str(folder / name)]
        if name != "reflectance_from_flashes":
            arguments += ["--size", str(HEIGHT)]
        runpy.run_path(str(ROOT / "examples" / f"{name}.py"))["main"](arguments)
    relit = folder / "relight_sweep"
    frames = [relit / "frames" / f"frame_{k:03d}.png" for k in (0, 4, 7, 11)]
    lamps = sorted((folder / "reflectance_from_flashes").glob("lamp_*.ply"))
    swaps = ["A", "B", "A with B's skin", "B with A's skin"]
    blends = ["A", "a quarter of B", "half of B", "3/4 of B", "B"]
    smiles = ["A", "A smiling", "B", "B with A's smile", "1.5 times that"]
    return {
        "relit": [
            ("two lamps", picture(relit / "portrait.png", whole=True)),
            ("a sky", picture(relit / "sky.png")),
            *(("a lamp moves", picture(frame)) for frame in frames),
        ],
        "swapped": strip(folder / "swap_and_blend" / "swaps.png", swaps),
        "blended": strip(folder / "swap_and_blend" / "blends.png", blends),
        "expressions": strip(folder / "transfer_expression" / "expressions.png", smiles),
        "reflectance": [(f"lamp {k}", lit_mesh(path)) for k, path in enumerate(lamps, 1)],
    }


def picture(path: Path, *, whole: bool = False) -> Pixels:
    with Image.open(path) as opened:
        pixels = np.asarray(opened.convert("RGB"))
    return pixels if whole else narrow(pixels)


def strip(path: Path, titles: list[str]) -> Panels:
    """Return the square pictures that stand side by side in a file, with a title each."""
    with Image.open(path) as opened:
        whole = np.asarray(opened.convert("RGB"))
    parts = np.split(whole, len(titles), axis=1)
    return [(title, narrow(part)) for title, part in zip(titles, parts, strict=True)]


def lit_mesh(path: Path) -> Pixels:
    """Return a mesh with the colours of its vertices, which are those of skin in a lamp's light."""
    mesh = trimesh.load(path, process=False)
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255
    return narrow(rendered(mesh.vertices, mesh.faces, vertex_color_srgb=colors, shaded=False))


if __name__ == "__main__":
    main()
