"""The demo of glasses: a synthetic frame registered on its wearer's fitted face, compared with the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo.core import ProgressCallback
from scan2albedo.core.arrays import FloatArray, IntArray
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
from scan2albedo.fitting import fit
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import camera_centers
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.io.atomic import check_writable, result_folder
from scan2albedo.io.glb import write_glb
from scan2albedo.io.obj import write_obj
from scan2albedo.registration import register
from scan2albedo.runs.eyeglasses.input import keypoints_beside
from scan2albedo.runs.eyeglasses.lens_files import run_lenses
from scan2albedo.runs.eyeglasses.lens_input import read_lens_input
from scan2albedo.runs.eyeglasses.register_run import PlacedFrame, register_frame, write_registration_files
from scan2albedo.runs.eyeglasses.registration_input import RegistrationFiles, read_registration
from scan2albedo.synthetic import RawScanOptions, Wearer, WearerOptions, raw_scan, wearer
from scan2albedo.templates import AnnotatedFaceModel

Mesh = tuple[FloatArray, IntArray]

Head = Literal["fitted", "true", "none"]

INPUT = "input"
"""Folder with what a person who takes pictures would bring."""
LENSES = "lenses"
"""Folder with the picture through lenses."""
_SHAPE_ONLY = RawScanOptions(size=64, picture_size=64)
"""Neither registration nor fit look at the scan's pictures."""


@dataclass(frozen=True)
class GlassesDemoReport:
    """Errors of the registration against the truth; lengths in mm, shares of the vertices.

    Errors are those of vertices that the true head leaves visible in a view or more (`seen`), of `all`, of
    those that the registration calls `observed`, and of the key points; `depth_error_mm` is along the line of
    sight, in the view where it is least. Deviations are the registration's own estimate: root mean squares
    over the observed vertices, each in its worst direction, and along the line of sight.
    """

    placed: PlacedFrame
    head: Head
    seen_rms_mm: float
    seen_max_mm: float
    seen_share: float
    all_rms_mm: float
    all_max_mm: float
    observed_rms_mm: float
    observed_share: float
    observed_deviation_mm: float
    keypoints_rms_mm: float
    keypoints_max_mm: float
    depth_error_mm: float
    depth_deviation_mm: float
    seconds: float

    def figures(self) -> dict[str, Any]:
        """Return the figures as plain values for JSON."""
        plain = {k: v for k, v in vars(self).items() if isinstance(v, int | float | str)}
        return {**plain, "converged": self.placed.result.converged, "views": self.placed.view_figures()}

    def table(self) -> str:
        """Return the figures as text for a terminal."""
        heads = {"fitted": "face fitted to a scan", "true": "true head", "none": "no head"}
        rows = (
            ("visible vertices", self.seen_rms_mm, self.seen_max_mm, f"{self.seen_share:.1%} of the frame"),
            ("all vertices", self.all_rms_mm, self.all_max_mm, ""),
            ("key points", self.keypoints_rms_mm, self.keypoints_max_mm, ""),
        )
        lines = [
            f"  {name:18}{rms:.3f} mm rms, {most:.3f} mm at most" + (f"; {more}" if more else "")
            for name, rms, most, more in rows
        ]
        lines.append(
            f"  {'observed':18}{self.observed_rms_mm:.3f} mm rms, "
            f"{self.observed_deviation_mm:.3f} mm stated; {self.observed_share:.1%} of the frame"
        )
        lines.append(
            f"  {'depth':18}{self.depth_error_mm:.3f} mm rms, {self.depth_deviation_mm:.3f} mm stated"
        )
        ended = "converged" if self.placed.result.converged else "not converged"
        lines.append(f"  {'registration':18}{self.seconds:.1f} s, {ended}")
        return "\n".join([f"error against the ground truth ({heads[self.head]}):", *lines])


def compare_with_wearer(placed: PlacedFrame, person: Wearer, head: Head = "fitted") -> GlassesDemoReport:
    """Return the errors of a registered synthetic frame."""
    result, glasses = placed.result, person.glasses
    # Reading a mesh may drop and renumber vertices.
    same = cKDTree(glasses.rest_vertices).query(placed.given.frame.vertices)[1]
    error = np.linalg.norm(result.vertices - person.vertices[same], axis=1)
    seen, observed = person.seen[same], result.observed
    off = result.keypoints - person.keypoints
    marks = np.linalg.norm(off, axis=1)
    return GlassesDemoReport(
        placed=placed,
        head=head,
        seen_rms_mm=_rms(error[seen]),
        seen_max_mm=float(error[seen].max()),
        seen_share=float(seen.mean()),
        all_rms_mm=_rms(error),
        all_max_mm=float(error.max()),
        observed_rms_mm=_rms(error[observed]),
        observed_share=float(observed.mean()),
        observed_deviation_mm=_rms(result.deviation[observed]),
        keypoints_rms_mm=_rms(marks),
        keypoints_max_mm=float(marks.max()),
        depth_error_mm=_depth_error(person, off),
        depth_deviation_mm=result.depth_deviation,
        seconds=placed.seconds,
    )


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")


def _depth_error(person: Wearer, off: FloatArray) -> float:
    """Return the root mean square error (20, 3) along the rays of visible key points, least of all views."""
    errors = []
    for center, hidden in zip(camera_centers(person.cameras), person.hidden, strict=True):
        shown = ~hidden[person.glasses.keypoint_vertices]
        rays = normalized(person.keypoints[shown] - center)
        errors.append(_rms(np.einsum("ki,ki->k", rays, off[shown])))
    return float(np.nanmin(errors))


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

    Then lenses of so many `dioptres` are put into the registered frame and drawn in the middle view, into
    `LENSES`; None, or no head to see through them, for no lenses. `out` gets the results, and in `INPUT` the
    files they were made from. The head is "fitted": the face that `register` and `fit` find in a raw scan of
    the person, brought into the cameras' frame by the scan's true pose, as a calibrated rig knows it; "true":
    the person's own; or "none". `say` is called with lines on the lenses.
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
    """Write the data of a wearer into ``out / INPUT`` and return the files' names.

    They are the frame before it was bent, its key points, cameras, labels, masks, and the head if any. Raises
    OutputError, naming folder and cause.
    """
    folder, glasses = out / INPUT, person.glasses
    _, height, width = person.masks.shape
    cameras = [
        Camera(f"camera_{number}", matrix, (height, width))
        for number, matrix in enumerate(person.cameras, start=1)
    ]
    with result_folder(folder, staged_in=out) as staging:
        write_obj(staging / "frame.obj", glasses.rest_vertices, glasses.faces)
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
