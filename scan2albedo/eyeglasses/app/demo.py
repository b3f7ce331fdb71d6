"""The demo of glasses: a synthetic frame registered on its wearer's fitted face, compared with the truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.core import ProgressCallback
from scan2albedo.errors import OutputError
from scan2albedo.eyeglasses import (
    Camera,
    LensMaterial,
    LensPictureOptions,
    read_cameras,
    write_cameras,
    write_keypoints,
    write_labels,
    write_masks,
)
from scan2albedo.eyeglasses.app.demo_report import GlassesDemoReport, Head, compare_with_wearer
from scan2albedo.eyeglasses.app.input import keypoints_beside
from scan2albedo.eyeglasses.app.lens_input import read_lens_input
from scan2albedo.eyeglasses.app.lens_run import run_lenses
from scan2albedo.eyeglasses.app.registration import register_frame
from scan2albedo.eyeglasses.app.registration_files import write_registration_files
from scan2albedo.eyeglasses.app.registration_input import RegistrationFiles, read_registration
from scan2albedo.face_model import AnnotatedFaceModel
from scan2albedo.fitting import fit
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.io.glb import write_glb
from scan2albedo.io.result_folder import check_writable, result_folder
from scan2albedo.registration import register
from scan2albedo.synthetic import RawScanOptions, Wearer, WearerOptions, raw_scan, wearer

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mesh = tuple[FloatArray, IntArray]

INPUT = "input"
"""Folder with what a person who takes pictures would bring."""
LENSES = "lenses"
"""Folder with the picture through lenses."""
_SHAPE_ONLY = RawScanOptions(size=64, picture_size=64)
"""Neither registration nor fit look at the scan's pictures."""


def run_glasses_demo(
    out: str | Path,
    *,
    seed: int = 0,
    head: Head = "fitted",
    options: WearerOptions = WearerOptions(),
    dioptres: float | None = -6.0,
    on_progress: ProgressCallback | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> GlassesDemoReport:
    """Photograph a synthetic person with glasses, register the frame on the face, compare with the truth.

    Then lenses are put into the registered frame and drawn in the middle view, into `LENSES`.

    Parameters
    ----------
    out : path
        Folder for the results, with the files they were made from in `INPUT`.
    seed : int
        Of the person, the frame, the noise, and the scan that the face is fitted to.
    head : str
        "fitted": the face that `register` and `fit` find in a raw scan of the person, brought into the
        cameras' frame by the scan's true pose, as a calibrated rig knows it; "true": the person's own head;
        "none".
    options : WearerOptions
        Of the pictures.
    dioptres : float, optional
        Of both lenses; None, and no head to see through them, for no lenses.
    on_progress : callable, optional
        Called with every `TraceRow`.
    say : callable, optional
        Called with lines on the lenses.
    """
    folder = Path(out)
    check_writable(folder)
    person = wearer(seed, options=options)
    files = write_wearer(person, _head(person, head, seed, on_progress), folder)
    placed = register_frame(read_registration(files), on_progress=on_progress)
    write_registration_files(placed, folder)
    if dioptres is not None and files.head is not None:
        _draw_lenses(folder, files, dioptres, say)
    return compare_with_wearer(placed, person, head)


def _draw_lenses(folder: Path, files: RegistrationFiles, dioptres: float, say: Callable[[str], None]) -> None:
    """Draw lenses in the registered frame, from the files that `glasses lenses` would read."""
    assert files.head is not None
    names = [camera.name for camera in read_cameras(files.cameras)]
    source = read_lens_input(
        folder / "registered.glb", files.head, files.cameras, views=[names[len(names) // 2]]
    )
    lens = LensMaterial(dioptres=dioptres, beta=0.04)
    run_lenses(source, (lens, lens), LensPictureOptions(), folder / LENSES, say)


def fitted_face(seed: int, on_progress: ProgressCallback | None = None) -> Mesh:
    """Return the face fitted to a raw scan of the person of `wearer(seed)`, in that wearer's world."""
    scan, truth = raw_scan(seed, options=_SHAPE_ONLY)
    model = AnnotatedFaceModel.default()
    pose = register(scan, model, seed=seed, on_progress=on_progress)
    fitted = fit(scan, model, pose, on_progress=on_progress)
    world_from_fit = truth.model_from_scan @ invert_rigid(fitted.model_from_scan)
    return transform_points(world_from_fit, fitted.vertices), fitted.faces


def _head(person: Wearer, head: Head, seed: int, on_progress: ProgressCallback | None) -> Mesh | None:
    if head == "fitted":
        return fitted_face(seed, on_progress)
    return (person.head_vertices, person.head_faces) if head == "true" else None


def write_wearer(person: Wearer, head: Mesh | None, out: Path) -> RegistrationFiles:
    """Write what is known of a wearer into ``out / INPUT`` and return the files' names.

    The frame as it was before it was bent, its key points, cameras, labels, masks, and the head if any.

    Raises
    ------
    OutputError
        Naming the folder and the cause.
    """
    folder, glasses = out / INPUT, person.glasses
    _, height, width = person.masks.shape
    cameras = [
        Camera(f"camera_{number}", matrix, (height, width))
        for number, matrix in enumerate(person.cameras, start=1)
    ]
    with result_folder(folder, staged_in=out) as staging:
        _write_obj(staging / "frame.obj", (glasses.rest_vertices, glasses.faces))
        write_keypoints(keypoints_beside(staging / "frame.obj"), glasses.rest_keypoints, unit="mm")
        write_cameras(staging / "cameras.json", cameras)
        write_labels(staging / "labels.json", person.labels, [camera.name for camera in cameras])
        write_masks(staging / "masks", list(person.masks), cameras)
        if head is not None:
            write_glb(staging / "head.glb", *head)
    return RegistrationFiles(
        mesh=folder / "frame.obj",
        cameras=folder / "cameras.json",
        labels=folder / "labels.json",
        masks=folder / "masks",
        head=None if head is None else folder / "head.glb",
    )


def _write_obj(path: Path, mesh: Mesh) -> None:
    import igl

    igl.writeOBJ(str(path), *mesh)
    if not path.is_file():
        raise OutputError(f"{path} cannot be written")
