"""The demo of reflectance: synthetic people photographed, fitted, modelled, and compared with the truth."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from scan2albedo import reflectance
from scan2albedo.albedo import albedo_error
from scan2albedo.core import OnProgress
from scan2albedo.core.arrays import EPSILON, FloatArray, IntArray, Values, norms
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.rigid import procrustes, transform_points
from scan2albedo.io.atomic import write_text
from scan2albedo.io.images import write_png
from scan2albedo.io.records import OwnFileNames, Record, write_record
from scan2albedo.io.run_folder import OwnFiles, RunFolder
from scan2albedo.lighting.environment import texel_directions
from scan2albedo.reflectance import OlatOptions, VertexReflectance
from scan2albedo.reflectance.capture_files import FacePhotographFile, FlashCaptureFile, PairEntry, PoseEntry
from scan2albedo.runs.reflectance import model_run
from scan2albedo.runs.reflectance.capture_run import fit_capture, write_fit, write_olat
from scan2albedo.runs.reflectance.image_run import fit_photograph, tune_model, write_fitted_photograph
from scan2albedo.synthetic import FacePhotograph, FlashCapture, Portrait, face_photograph, flash_capture

_PORTRAIT = Portrait(picture_size=192)
"""People have no hair: its shadows on the brow are not the mesh's, and a model would learn them as skin."""
CAPTURE_FILE, PHOTOGRAPH_FILE, LANDMARKS_FILE = "capture.json", "photograph.json", "landmark_vertices.json"
_MESH, _IMAGE, _SKIN = "face.ply", "image.png", "skin.png"


def report_lines(figures: Values) -> list[str]:
    """Return the figures of `run_reflectance_demo` as text."""
    percent = {name: 100 * np.mean(figures[name]) for name in figures if name.endswith("_error")}
    return [
        f"error against the ground truth, {figures['people']} people with 35 pairs of pictures each:",
        f"  albedo of vertices        relative RMSE {percent['diffuse_error']:.1f} %, median "
        f"{percent['diffuse_median_error']:.1f} %",
        f"  pictures left out         relative RMSE {percent['held_out_error']:.1f} %",
        "a person whom the model does not know, from one photograph in unknown light:",
        f"  albedo, mesh known        relative RMSE {percent['mesh_known_error']:.1f} %",
        f"  albedo, from landmarks    relative RMSE {percent['landmarks_error']:.1f} %",
        f"  the model's mean instead  relative RMSE {percent['mean_face_error']:.1f} %",
        f"  the model's nearest face  relative RMSE {percent['nearest_error']:.1f} %",
        f"  shape from landmarks      {figures['shape_error_mm']:.2f} mm mean, of the mean shape "
        f"{figures['mean_shape_error_mm']:.2f} mm",
        f"fine-tuning: {figures['accepted_steps']} changes accepted, held-out objective "
        f"{figures['tuning_before']:.4g} -> {figures['tuning_after']:.4g}",
    ]


def run_reflectance_demo(
    out: Path,
    *,
    people: int = 8,
    photographs: int = 12,
    seed: int = 0,
    on_progress: OnProgress = None,
    say: Callable[[str], None] = lambda line: None,
) -> Values:
    """Photograph people with flashes, learn a model, use it on photographs of others, compare with the truth.

    Everything goes through files, as with real pictures: ``captures``, ``fits``, ``model``, ``samples``,
    ``photographs``, ``fit_image`` and ``tuned`` in `out`. The model is learned from 2 or more `people`;
    `photographs`, 2 or more, are of others, half of them held out from fine-tuning. Errors of albedos are
    relative RMSE, of those of photographs at the best scale; shapes are aligned rigidly.
    """
    fits, errors = [], []
    for number in range(people):
        say(f"person {number + 1} of {people}: taking and fitting pictures")
        capture = flash_capture(seed + number, views=5, flashes=7, hair=False, levels=1, portrait=_PORTRAIT)
        file = write_synthetic_capture(capture, out / "captures" / f"person_{number:02d}")
        if number == 0:
            write_olat(reflectance.read_capture(file), out / "olat")
        options = reflectance.ReflectanceFitOptions(least_pairs=3)
        done = fit_capture(reflectance.read_capture(file), options=options, on_progress=on_progress)
        fits.append(out / "fits" / f"person_{number:02d}")
        write_fit(done, fits[-1], {"least_pairs": options.least_pairs})
        assert done.error is not None
        found, known = done.fit.reflectance.diffuse_linear, done.fit.reflectance.known
        albedo = capture.diffuse_linear[known]
        off = found[known] - albedo  # the scale is known
        rmse, median = np.sqrt(np.mean(off**2) / np.mean(albedo**2)), np.median(np.abs(off / albedo))
        errors.append((rmse, median, done.error.relative_rmse))
    landmarks = out / "captures" / "person_00" / LANDMARKS_FILE
    model_run.write_model_folder(model_run.build_model(fits, landmark_vertices=landmarks), out / "model", {})
    model_run.write_samples(out / "model", out / "samples", count=6, seed=seed)
    models = model_run.read_model_folder(out / "model")
    say("fitting a photograph of another person")
    others = seed + 1000  # seeds of people that the model was not learned from
    taken, fitted = _photograph(others, 0), []
    for name in ("mesh", "landmarks"):
        file = write_synthetic_photograph(taken, out / "photographs" / name, mesh=name == "mesh")
        fitted.append(fit_photograph(reflectance.read_photograph(file), models, on_progress=on_progress))
        write_fitted_photograph(fitted[-1], models, out / "fit_image" / name, {})
    with_mesh, marked = fitted
    say("fine-tuning")
    files = [
        write_synthetic_photograph(
            _photograph(others + 1 + number, number + 1), out / "photographs" / f"{number:02d}"
        )
        for number in range(photographs)
    ]
    tuned = tune_model(models, files[::2], files[1::2], out / "tuned", {}, on_progress=on_progress)
    truth, shape, seen = taken.diffuse_linear, taken.vertices, np.asarray(with_mesh.observation.seen)
    used, nearest = seen & models.model.known, models.mean.reflectance
    # The nearest face, by turns of scale and coefficients; the ridge only keeps the solution unique.
    for _ in range(30):
        a, b = nearest.diffuse_linear[used], truth[used]
        scaled = VertexReflectance(truth * (np.sum(a * b) / np.sum(b * b)), np.zeros_like(truth), seen)
        nearest = models.model.project(scaled, prior=EPSILON).reflectance

    def scaled_error(found: VertexReflectance) -> float:
        """Return the relative RMSE at the best scale, over vertices that were seen and are known."""
        return albedo_error(found.diffuse_linear, truth, seen & found.known).relative_rmse

    def shape_error_mm(found: FloatArray) -> float:
        aligned = transform_points(procrustes(found, shape[seen]), found)
        return float(norms(aligned - shape[seen]).mean())

    diffuse, diffuse_median, predicted = zip(*errors, strict=True)
    return {
        "people": people,
        "diffuse_error": diffuse,
        "diffuse_median_error": diffuse_median,
        "held_out_error": predicted,
        "mesh_known_error": scaled_error(with_mesh.face.reflectance),
        "landmarks_error": scaled_error(marked.face.reflectance),
        "mean_face_error": scaled_error(models.mean.reflectance),
        "nearest_error": scaled_error(nearest),
        "shape_error_mm": shape_error_mm(marked.vertices[seen]),
        "mean_shape_error_mm": shape_error_mm(models.mean.vertices[seen]),
        "tuning_before": tuned["held_out_before"],
        "tuning_after": tuned["held_out_after"],
        "accepted_steps": len(tuned["accepted_steps"]),
    }


def _photograph(seed: int, number: int) -> FacePhotograph:
    """Photograph a person in a grey room with three soft lamps, from a warm one to a cool one."""
    rng, toward = np.random.default_rng(seed), texel_directions((32, 64))
    lamps = normalized(rng.normal(size=(3, 3)) + [0.0, 1.0, 1.0])
    tints = rng.uniform(4, 16, (3, 1)) * [[1.2, 1.0, 0.8], [1.0, 1.0, 1.0], [0.8, 1.0, 1.2]]
    room = 1 + np.exp(20 * (toward @ lamps.T - 1)) @ tints
    azimuth = (0.0, 20.0, -20.0)[number % 3]
    return face_photograph(seed, room, azimuth_deg=azimuth, lights=128, hair=False, portrait=_PORTRAIT)


class SyntheticRecord(Record):
    """The content of `synthetic.json`, beside pictures of synthetic people."""

    format_version: Literal[1] = 1
    files: OwnFileNames = ()


_OWN_FILES = OwnFiles(
    "synthetic.json",
    SyntheticRecord,
    (CAPTURE_FILE, PHOTOGRAPH_FILE, LANDMARKS_FILE, _MESH, _IMAGE, "skin*.png", "flash_*.png", "room_*.png"),
    command="scan2albedo reflectance demo",
)


def write_synthetic_capture(capture: FlashCapture, folder: Path) -> Path:
    """Write pictures, masks, mesh, landmarks and capture file of a synthetic capture; return its path."""
    options = capture.portrait
    _require_bits(options)
    with RunFolder(folder, _OWN_FILES).publishing() as staging:
        _write_mesh(staging.folder / _MESH, capture.vertices, capture.faces)
        distance = norms(capture.landmarks[:, None] - capture.vertices[None])
        write_text(staging.folder / LANDMARKS_FILE, json.dumps(distance.argmin(1).tolist()) + "\n")
        pairs = []
        for j, (view, light) in enumerate(zip(capture.view, capture.light, strict=True)):
            flash, room = f"flash_{view:02d}_{light:02d}.png", f"room_{view:02d}.png"
            write_png(staging.folder / flash, capture.flash[j])
            if light == 0:
                write_png(staging.folder / room, capture.room[j])
                write_png(staging.folder / f"skin_{view:02d}.png", np.uint8(255) * capture.skin[j])
            places = {"camera": f"place_{view:02d}", "flash": f"place_{light:02d}"}
            pairs.append(PairEntry(**places, flash_image=flash, room_image=room))
        poses = [
            PoseEntry(
                name=f"place_{k:02d}",
                rotation=rotation.tolist(),
                translation=translation.tolist(),
                intrinsics=None,
                mask=f"skin_{k:02d}.png" if k <= capture.view.max() else None,
            )
            for k, (rotation, translation) in enumerate(
                zip(capture.head_rotations, capture.head_translations, strict=True)
            )
        ]
        content = FlashCaptureFile(
            mesh=_MESH,
            gamma=options.gamma,
            noise=max(options.noise, 0.5 / 255),
            saturation=OlatOptions.saturation,
            falloff_distance=options.distance_mm,
            flash_strength=capture.exposure,
            intrinsics=capture.intrinsics.tolist(),
            poses=tuple(poses),
            pictures=tuple(pairs),
        )
        reflectance.write_capture(staging.folder / CAPTURE_FILE, content)
        staging.write_record()
    return folder / CAPTURE_FILE


def write_synthetic_photograph(taken: FacePhotograph, folder: Path, *, mesh: bool = True) -> Path:
    """Write image, mask, landmarks and, with `mesh`, the mesh; return the photograph file's path."""
    _require_bits(taken.portrait)
    landmarks = [None if np.isnan(pixel).any() else pixel.tolist() for pixel in taken.landmarks_px]
    with RunFolder(folder, _OWN_FILES).publishing() as staging:
        write_png(staging.folder / _IMAGE, taken.image)
        write_png(staging.folder / _SKIN, np.uint8(255) * taken.skin)
        if mesh:
            _write_mesh(staging.folder / _MESH, taken.vertices, taken.faces)
        content = FacePhotographFile.model_validate(
            {
                "image": _IMAGE,
                "mask": _SKIN,
                "gamma": taken.portrait.gamma,
                "saturation": OlatOptions.saturation,
                "camera": taken.camera.tolist(),
                "mesh": _MESH if mesh else None,
                "landmarks": landmarks,
            }
        )
        write_record(staging.folder / PHOTOGRAPH_FILE, content, indent=1)
        staging.write_record()
    return folder / PHOTOGRAPH_FILE


def _require_bits(portrait: Portrait) -> None:
    if portrait.bits is None:
        raise ValueError("pictures without bits cannot be written as PNG; take 8 or 16 bits")


def _write_mesh(path: Path, vertices: FloatArray, faces: IntArray) -> None:
    import trimesh

    trimesh.Trimesh(vertices, faces, process=False).export(path)
