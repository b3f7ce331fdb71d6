"""The demo of glasses: a synthetic frame registered on its wearer's fitted face, compared with the truth."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from scan2albedo import eyeglasses
from scan2albedo.core import OnProgress
from scan2albedo.core.arrays import FloatArray, IntArray, Values, dots, norms, rms
from scan2albedo.errors import OutputError
from scan2albedo.eyeglasses import Camera, LensMaterial, write_keypoints, write_labels
from scan2albedo.fitting import fit
from scan2albedo.geometry.mesh import normalized
from scan2albedo.geometry.pinhole import camera_centers
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.io.atomic import check_writable
from scan2albedo.io.glb import write_glb
from scan2albedo.io.input_hash import file_sha256, input_sha256
from scan2albedo.io.obj import write_obj
from scan2albedo.io.publication import result_folder
from scan2albedo.io.run_folder import RunFolder
from scan2albedo.registration import register
from scan2albedo.runs.eyeglasses import inputs, lenses_run, register_run
from scan2albedo.runs.eyeglasses.inputs import GlassesInput, keypoints_path
from scan2albedo.runs.eyeglasses.lenses_run import run_lenses
from scan2albedo.runs.eyeglasses.register_run import PlacedFrame, register_frame, write_registration_files
from scan2albedo.synthetic import Scanner, Wearer, raw_scan, wearer
from scan2albedo.templates import AnnotatedFaceModel

Mesh = tuple[FloatArray, IntArray]

Head = Literal["fitted", "none"]

INPUT = "input"
"""Folder with what a person who takes pictures would bring."""
LENSES = "lenses"
"""Folder with the picture through lenses."""


@dataclass(frozen=True)
class GlassesDemoReport:
    """Errors of the registration against the truth."""

    placed: PlacedFrame
    head: Head
    errors: Mapping[str, float]
    """Lengths in mm and shares of the vertices: of those that a view truly sees (`seen`), of `all`, of those
    called `observed`, and of the key points; `depth_error_mm` is along the line of sight, in the view where
    it is least. Deviations are the registration's own estimate."""

    def figures(self) -> Values:
        """Return the figures as plain values for JSON."""
        placed, views = self.placed, [view.model_dump() for view in self.placed.views]
        rest = {"seconds": placed.seconds, "converged": placed.result.converged, "views": views}
        return {"head": self.head, **self.errors, **rest}

    def table(self) -> str:
        """Return the figures as text for a terminal."""
        errors = self.errors
        ended = "converged" if self.placed.result.converged else "not converged"
        parts = (("visible vertices", "seen"), ("all vertices", "all"), ("key points", "keypoints"))
        mm = {name: f"{value:.3f} mm" for name, value in errors.items()}
        rows = {name: f"{mm[f'{of}_rms_mm']} rms, {mm[f'{of}_max_mm']} at most" for name, of in parts}
        rows["visible vertices"] += f"; {errors['seen_share']:.1%} of the frame"
        rows["observed"] = f"{mm['observed_rms_mm']} rms, {mm['observed_deviation_mm']} stated; "
        rows["observed"] += f"{errors['observed_share']:.1%} of the frame"
        rows["depth"] = f"{mm['depth_error_mm']} rms, {mm['depth_deviation_mm']} stated"
        rows["registration"] = f"{self.placed.seconds:.1f} s, {ended}"
        head = "face fitted to a scan" if self.head == "fitted" else "no head"
        lines = [f"  {name:18}{row}" for name, row in rows.items()]
        return "\n".join([f"error against the ground truth ({head}):", *lines])


def compare_with_wearer(placed: PlacedFrame, person: Wearer, head: Head = "fitted") -> GlassesDemoReport:
    """Return the errors of a registered synthetic frame."""
    result, glasses = placed.result, person.glasses
    # Reading a mesh may drop and renumber vertices.
    same = cKDTree(glasses.rest_vertices).query(placed.inputs.frame.scan.vertices)[1]
    error = norms(result.vertices - person.vertices[same])
    seen, observed = person.seen[same], result.observed
    off = result.keypoints - person.keypoints
    marks = norms(off)
    # Along the rays of visible key points, least of all views.
    depth_errors = []
    for center, hidden in zip(camera_centers(person.cameras), person.hidden, strict=True):
        shown = ~hidden[glasses.keypoint_vertices]
        rays = normalized(person.keypoints[shown] - center)
        depth_errors.append(rms(dots(rays, off[shown])))
    errors = {
        "seen_rms_mm": rms(error[seen]),
        "seen_max_mm": error[seen].max(),
        "seen_share": seen.mean(),
        "all_rms_mm": rms(error),
        "all_max_mm": error.max(),
        "observed_rms_mm": rms(error[observed]),
        "observed_share": observed.mean(),
        "observed_deviation_mm": rms(result.deviation[observed]),
        "keypoints_rms_mm": rms(marks),
        "keypoints_max_mm": marks.max(),
        "depth_error_mm": np.nanmin(depth_errors),
        "depth_deviation_mm": result.depth_deviation,
    }
    return GlassesDemoReport(placed, head, errors)


def run_glasses_demo(
    out: str | Path,
    *,
    seed: int = 0,
    head: Head = "fitted",
    person: Wearer | None = None,
    on_progress: OnProgress = None,
    say: Callable[[str], None] = lambda line: None,
) -> GlassesDemoReport:
    """Photograph a synthetic person with glasses, register the frame on the face, compare with the truth.

    Then lenses are put into the registered frame and drawn in the middle view, into `LENSES`. `out` gets the
    results, and in `INPUT` the files they were made from. The head is "fitted", the face that `register` and
    `fit` find in a raw scan, placed by the scan's true pose; or "none", and no lenses. A `person` takes the
    place of that of `seed`. `say` is called with lines on the lenses.
    """
    folder = Path(out)
    check_writable(folder)
    RunFolder(folder, register_run.FILES).check()
    RunFolder(folder / LENSES, lenses_run.FILES).check()
    person = person or wearer(seed)
    glasses_input = write_wearer(person, fitted_face(seed, on_progress) if head == "fitted" else None, folder)
    placed = register_frame(glasses_input, on_progress=on_progress)
    write_registration_files(placed, folder)
    if head == "fitted":
        # From the files that `glasses lenses` would read.
        middle = glasses_input.cameras[len(glasses_input.cameras) // 2].name
        head_file, cameras_file = (Path(glasses_input.files[what].file) for what in ("head", "cameras"))
        source = inputs.read_lens_scene(folder / "registered.glb", head_file, cameras_file, views=[middle])
        lens = LensMaterial(dioptres=-6.0, beta=0.04)
        run_lenses(source, (lens, lens), eyeglasses.LensPictureOptions(), folder / LENSES, say)
    return compare_with_wearer(placed, person, head)


def fitted_face(seed: int, on_progress: OnProgress = None) -> Mesh:
    """Return the face fitted to a raw scan of the person of `wearer(seed)`, in that wearer's world."""
    # Neither registration nor fit look at the scan's pictures.
    scan, truth = raw_scan(seed, scanner=Scanner(size=64, picture_size=64))
    model = AnnotatedFaceModel.default()
    pose = register(scan, model, seed=seed, on_progress=on_progress)
    fitted = fit(scan, model, pose, on_progress=on_progress)
    world_from_fit = truth.model_from_scan @ invert_rigid(fitted.model_from_scan)
    return transform_points(world_from_fit, fitted.vertices), fitted.faces


def write_wearer(person: Wearer, head: Mesh | None, out: Path) -> GlassesInput:
    """Write the data of a wearer into ``out / INPUT`` and return what `read_registration` reads there.

    Raises OutputError, naming folder and cause, also where a file that no run wrote is in the way.
    """
    folder, glasses = out / INPUT, person.glasses
    _, height, width = person.masks.shape
    cameras = [Camera(f"camera_{n}", own, (height, width)) for n, own in enumerate(person.cameras, start=1)]
    known: set[str] = set()
    if (out / register_run.FILES.record).is_file():
        known = {file.sha256 for file in RunFolder(out, register_run.FILES).read().inputs.values()}
    with result_folder(folder, staged_in=out) as staging:
        write_obj(staging / "frame.obj", glasses.rest_vertices, glasses.faces)
        write_keypoints(keypoints_path(staging / "frame.obj"), glasses.rest_keypoints, unit="mm")
        eyeglasses.write_cameras(staging / "cameras.json", cameras)
        write_labels(staging / "labels.json", person.labels, [camera.name for camera in cameras])
        eyeglasses.write_masks(staging / "masks", list(person.masks), cameras)
        if head is not None:
            write_glb(staging / "head.glb", *head)
        for made in staging.rglob("*"):
            there = folder / made.relative_to(staging)
            if made.is_file() and there.is_file():
                hashes = {file_sha256(there), input_sha256(there) if there.suffix in (".obj", ".glb") else ""}
                if file_sha256(made) not in hashes and not hashes & known:
                    said = "no run of scan2albedo glasses demo wrote it"
                    raise OutputError(f"{there}: {said}; move it away, or choose another folder")
    skull, parts = None if head is None else folder / "head.glb", ("frame.obj", "cameras.json", "labels.json")
    return inputs.read_registration(*(folder / name for name in parts), masks=folder / "masks", head=skull)
