"""The demo: a synthetic raw scan through the whole pipeline, compared with its ground truth."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from scan2albedo.albedo import AlbedoError, albedo_error
from scan2albedo.core import OnProgress
from scan2albedo.core.arrays import Values, norms
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rigid import invert_rigid, rotation_angle_rad, transform_points
from scan2albedo.io.run_folder import RunFolder
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.pipeline.process import FILES, process
from scan2albedo.pipeline.quality import Quality
from scan2albedo.pipeline.result import ProcessResult
from scan2albedo.synthetic import Scanner, SyntheticTruth, raw_scan


@dataclass(frozen=True)
class DemoReport:
    """Errors of the pipeline's result against the truth.

    `pose_translation_mm` is the difference at the face's centroid; `surface_mm` the mean distance of the true
    face to the fitted surface; `correspondence_mm` that of the true and the fitted surface point of each
    texel; `landmarks_mm` the mean error of the 51 inner landmarks; `light_deg` the greatest angle between a
    true light and the found light nearest to it; `texture` and `albedo` the errors of the raw texture and of
    the estimated albedo against the true albedo of the same surface point.
    """

    result: ProcessResult
    pose_rotation_deg: float
    pose_translation_mm: float
    surface_mm: float
    correspondence_mm: float
    landmarks_mm: float
    light_deg: float
    lights_found: int
    lights_true: int
    texture: AlbedoError
    albedo: AlbedoError

    def figures(self) -> Values:
        """Return the figures as plain numbers for JSON."""
        plain = {k: v for k, v in vars(self).items() if isinstance(v, int | float)}
        seconds = sum(self.result.timings_s.values())
        return {**plain, "texture": asdict(self.texture), "albedo": asdict(self.albedo), "seconds": seconds}

    def table(self) -> str:
        """Return the figures as text for a terminal."""
        lights = f"{self.lights_found} found, {self.lights_true} true, {self.light_deg:.1f} deg off at most"
        rows = (
            ("pose", f"{self.pose_rotation_deg:.2f} deg, {self.pose_translation_mm:.2f} mm off"),
            ("surface", f"{self.surface_mm:.3f} mm mean distance of the true face"),
            ("correspondence", f"{self.correspondence_mm:.2f} mm mean over all texels"),
            ("51 inner landmarks", f"{self.landmarks_mm:.2f} mm mean"),
            ("lights", lights),
            ("texture as scanned", _albedo_text(self.texture)),
            ("estimated albedo", _albedo_text(self.albedo)),
        )
        return "\n".join(["error against the ground truth:", *(f"  {name:20}{text}" for name, text in rows)])


def run_demo(
    out: str | Path | None,
    *,
    seed: int = 0,
    size: int | None = None,
    quality: Quality | str = "standard",
    on_progress: OnProgress = None,
) -> DemoReport:
    """Scan a synthetic person, process the scan, compare with the truth.

    `seed` is that of person, pose, lights and pipeline; `out`, `size`, `quality` are as in `process`.
    """
    texels = ProcessOptions(size=size, quality=quality).texels
    if out is not None:
        RunFolder(Path(out) / f"synthetic-{seed}", FILES).check()
    scan, truth = raw_scan(seed, scanner=Scanner(size=texels))
    result = process(scan, out, size=size, quality=quality, seed=seed, on_progress=on_progress)
    return compare_with_truth(result, truth)


def compare_with_truth(result: ProcessResult, truth: SyntheticTruth) -> DemoReport:
    """Return the errors of a processed synthetic scan; its geometry image has the truth's size."""
    fitted, estimate = result.fitted, result.albedo
    if fitted is None or estimate is None or fitted.landmarks is None:
        raise ValueError("the comparison needs a fit with landmarks and an albedo; do not skip these stages")
    # Everything is compared in the frame of the true pose.
    truth_from_fit = truth.model_from_scan @ invert_rigid(fitted.model_from_scan)
    center, image = fitted.vertices.mean(0), result.geometry_image
    both = image.mask & truth.image.mask
    position = transform_points(truth_from_fit, image.position[both])
    landmarks = transform_points(truth_from_fit, fitted.landmarks)
    surface = ClosestPointQuery(transform_points(truth_from_fit, fitted.vertices), fitted.faces)
    # The true albedo at the surface points nearest to the texels; those at the chart's border have none near.
    true_vertices, true_faces = truth.image.triangulated()
    hits = ClosestPointQuery(true_vertices, true_faces).query(position)
    albedo = truth.albedo_linear[truth.image.mask]
    true_albedo = hits.interpolated(albedo, true_faces).astype(np.float32)
    usable = image.seen[both] & (hits.distance < 2.0)
    light_deg = float("nan")
    if estimate.lights:
        found = np.array([light.direction for light in estimate.lights]) @ truth_from_fit[:3, :3].T
        cosines = np.array([light.direction for light in truth.lights]) @ found.T
        light_deg = float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).min(axis=1).max())
    # iBUG-68 without the jaw line, which no point of a smooth jaw defines.
    inner = norms(landmarks - truth.landmarks)[17:]
    assert image.texture_linear is not None
    return DemoReport(
        result=result,
        pose_rotation_deg=float(np.degrees(rotation_angle_rad(truth_from_fit[:3, :3]))),
        pose_translation_mm=float(np.linalg.norm(transform_points(truth_from_fit, center[None])[0] - center)),
        surface_mm=float(surface.query(truth.image.position[truth.image.mask]).distance.mean()),
        correspondence_mm=float(norms(position - truth.image.position[both]).mean()),
        landmarks_mm=float(inner.mean()),
        light_deg=light_deg,
        lights_found=len(estimate.lights),
        lights_true=len(truth.lights),
        texture=albedo_error(image.texture_linear[both], true_albedo, usable),
        albedo=albedo_error(estimate.albedo_linear[both], true_albedo, usable),
    )


def _albedo_text(error: AlbedoError) -> str:
    return f"relative RMSE {100 * error.relative_rmse:.1f} % of the albedo, MSE {error.mse_percent:.3f} %"
