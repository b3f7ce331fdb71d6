"""`ProcessResult`: all results of one scan, and its files, all of them or none."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scan2albedo.core.arrays import ByteArray, FloatArray, RealArray, Texts, Values, attributes
from scan2albedo.core.raw_scan import lost_texture
from scan2albedo.geometry.rasterization import filled_from_nearest
from scan2albedo.geometry.rigid import invert_rigid, transform_points
from scan2albedo.io.color import is_deep
from scan2albedo.io.geometry_image_files import write_geometry_image, write_geometry_image_exr
from scan2albedo.io.glb import write_glb
from scan2albedo.io.images import write_exr, write_indexed_png, write_png
from scan2albedo.io.landmark_files import LANDMARKS_FILE, LandmarksRecord, write_landmarks_csv
from scan2albedo.io.npz import write_npz
from scan2albedo.io.obj import write_obj
from scan2albedo.io.records import write_record
from scan2albedo.io.result_records import InputRecord, RegistrationRecord, ResultRecord
from scan2albedo.io.run_folder import OwnFiles, RunFolder
from scan2albedo.io.textured_mesh import TexturedMesh, write_textured_glb
from scan2albedo.pipeline.mesh_files import gray_bytes, write_template, write_unlit
from scan2albedo.report.overview import figure_png, overview_figure, preview_srgb, result_panels

if TYPE_CHECKING:
    from scan2albedo.albedo import AlbedoEstimate
    from scan2albedo.core import GeometryImage, Plan, RawScan, Trace
    from scan2albedo.fitting import FittedFace
    from scan2albedo.fitting.linear_model import LinearModelFit
    from scan2albedo.registration import Registration
    from scan2albedo.unlit.light_removal import UnlitScan
    from scan2albedo.unlit.template_baking import TemplateTexture

RESULT_FILE = "result.json"
_MESH = (".glb", ".obj", ".mtl", ".png", ".*.png", ".exr", ".*.exr")
_MAPS = tuple(
    f"maps_{name}"
    for name in ("normal", "normal_directx", "occlusion", "roughness", "specular", "cavity", "displacement")
)
_PICTURES = frozenset({"overview.png", "error_vs_time.png"})
_LEFT_OUT = _PICTURES | {
    *("geometry_image.exr", "shading.exr", "specular.exr", "shadow.png", "skin.png", "labels.png"),
    "expected_error.exr",
}
"""What "minimal" results leave out: pictures for a person, what other files have, and the light's parts."""
FILES = OwnFiles(
    RESULT_FILE,
    ResultRecord,
    (
        *("geometry_image.npz", "albedo.exr", "albedo.png", "fitted.glb", "registration.json"),
        *(LANDMARKS_FILE, "landmarks.csv", "trace.csv", "coverage.png", "disagreement.png"),
        *("sequence.glb", "frames.npz", "coefficients.json", "linear_model.npz"),
        *sorted(_LEFT_OUT),
        *(f"{mesh}{end}" for mesh in ("template", "unlit", "maps") for end in _MESH),
        "maps.usda",
        *(f"unlit_{name}{end}" for name in ("confidence", "hair") for end in (".png", ".*.png")),
        *(
            f"{name}{end}"
            for name in ("template_normal", "template_hair", *_MAPS)
            for end in (".png", ".*.png")
        ),
        *("maps_displacement.exr", "maps_displacement.*.exr"),
    ),
    whole_folder=True,
)
"""Every file a result may have. Several pictures of an unlit scan have numbers, in the order of the scan's
materials, those of a template's tiles their UDIM numbers."""

SURE = 0.5
"""Confidence of a registration below which there is a doubt: whole faces have more."""


@dataclass(frozen=True)
class ProcessResult:
    """All results of one `scan`, with the `plan` and `trace` of its stages and the `seed` they had."""

    scan: RawScan
    registration: Registration | None
    """With the pose the fit ended with; None without a model, or when registration was skipped."""
    fitted: FittedFace | None
    """None without a model."""
    geometry_image: GeometryImage
    """The face, or the object, on its chart."""
    albedo: AlbedoEstimate | None
    """None when the scan has no colour, or the stage was skipped."""
    plan: Plan
    trace: Trace
    timings_s: Mapping[str, float]
    """Wall-clock seconds of each stage."""
    options: Mapping[str, Any]
    """What `process` was called with."""
    seed: int
    unlit: UnlitScan | None = None
    """The scan itself without its light, where it was asked for."""
    template: TemplateTexture | None = None
    """The model's own template with its texture, where it has coordinates and the scan has colour."""
    maps_of_skin: TemplateTexture | None = None
    """A mesh with the maps of a skin material, where they were asked for; see `engine_maps`."""
    linear_model: LinearModelFit | None = None
    """Coefficients of a linear model, where they were asked for; its mesh is the `template`."""
    source: Path | None = None
    """File the scan was read from."""
    out: Path | None = None
    """Folder with the files, when they were written."""
    maps: Mapping[str, RealArray] = field(default_factory=dict)
    """(H, W) from 0 to 1 by the name of the picture they are written to."""
    input_sha256: str | None = None
    """Of the file and those it refers to, before they were read (`io.input_sha256`); None without a file."""

    @property
    def notes(self) -> Texts:
        """What loading decided and repaired, and what is doubtful or wrong, one sentence each."""
        return (*self.scan.notes, *(step.text for step in self.plan.doubts()))

    @property
    def landmarks_scan(self) -> FloatArray | None:
        """(68, 3): the fit's landmarks in the scan's own frame and unit; None without a fit or landmarks."""
        if self.fitted is None or self.fitted.landmarks is None:
            return None
        in_mm = transform_points(invert_rigid(self.fitted.model_from_scan), self.fitted.landmarks)
        return in_mm / self.scan.mm_per_unit

    @property
    def expected_error(self) -> float | None:
        """Relative error of the albedo that is expected of half the texels, or of more; None without one."""
        if self.albedo is None or self.albedo.expected_error is None:
            return None
        return float(np.median(self.albedo.expected_error[self.albedo.image.mask]))

    def write_more(self, folder: Path, texture_srgb: ByteArray | None) -> None:
        """Write what a scan alone has not; `texture_srgb` (H, W, 3) is the albedo as it is shown."""

    def metrics(self) -> Values:
        """Return the figures of each stage, for summaries and result.json."""
        figures: Values = {"seconds": round(sum(self.timings_s.values()), 3)}
        if self.registration is not None:
            figures["registration"] = attributes(self.registration, "rmse_mm", "confidence", "converged")
        if self.fitted is not None:
            figures["fit"] = {**self.fitted.metrics, "converged": self.fitted.converged}
        if (linear := self.linear_model) is not None:
            figures["linear_model"] = {
                **attributes(linear, "noise_mm", "observations", "converged"),
                "residual_mean_mm": float(np.nanmean(linear.residual_mm)),
            }
        figures["geometry_image"] = self.geometry_image.figures()
        if self.albedo is not None:
            found = self.albedo
            figures["albedo"] = {"lights": len(found.lights), "parameters": dict(found.parameters)}
            figures["albedo"]["converged"] = found.converged
            if self.expected_error is not None:
                figures["albedo"]["expected_error"] = self.expected_error
            if found.uncertainty is not None:
                figures["albedo"]["uncertainty"] = found.uncertainty.figures()
        return figures

    def summary(self) -> str:
        """Return a summary of one line for a person."""
        parts = [f"{self.scan.name}: done in {sum(self.timings_s.values()):.1f} s"]
        if self.fitted is not None:
            parts.append(f"fit {np.nanmean(self.fitted.residual_mm):.2f} mm mean")
        if self.albedo is not None:
            lights = ", ".join(
                f"({np.degrees(light.azimuth_rad):.0f}, {np.degrees(light.elevation_rad):.0f}) deg"
                for light in self.albedo.lights
            )
            soft = "soft light" if self.albedo.environment is not None else "no directed light"
            parts.append(f"light at {lights}" if lights else soft)
            if self.expected_error is not None:
                parts.append(f"albedo +- {100 * self.expected_error:.0f} % a texel")
        else:
            parts.insert(1, f"no albedo: {lost_texture(self.scan.notes) or 'see the plan'}")
        if self.registration is not None and self.registration.confidence < SURE:
            parts.append(f"pose unsure (confidence {self.registration.confidence:.2f})")
        if any(step.stage == "texture" for step in self.plan.doubts()):
            parts.append("texture doubtful")
        stages = {"register": self.registration, "fit": self.fitted, "albedo": self.albedo}
        if unfinished := [name for name, found in stages.items() if found and not found.converged]:
            parts.append(f"not converged: {', '.join(unfinished)}")
        if self.out is not None:
            parts.append(f"files in {self.out}")
        return "; ".join(parts)


def write_result(
    result: ProcessResult,
    out: Path,
    *,
    files: str = "standard",
    pictures: bool = True,
    recorded: Collection[str] = (),
) -> Path:
    """Write every file of design section 6 into ``out / <scan name>`` and return that folder.

    They appear all at once, and an older result stays until then, see `RunFolder`; `recorded` are files that
    a batch's record says an earlier run wrote. `overview.png` and `error_vs_time.png` are left out without
    `pictures`, more where `files` is "minimal"; "all" adds linear EXR of the unlit scan and of the template.
    Their PNG have 16 bits where the scan's texture has more than 8. Raises `OutputError` when the folder is
    somebody else's or cannot be written.
    """
    left_out = _LEFT_OUT if files == "minimal" else frozenset() if pictures else _PICTURES
    image, estimate, exr = result.geometry_image, result.albedo, files == "all"
    preview = None if estimate is None else preview_srgb(estimate.albedo_linear, image.mask)
    # Colours go on beyond the mask: viewers that filter a texture mix in no white.
    shown = None if preview is None else filled_from_nearest(preview, image.mask).astype(np.uint8)
    texture = result.scan.texture_linear
    deep = np.uint16 if texture is not None and is_deep(texture) else np.uint8
    folder = RunFolder(out / result.scan.name, FILES, recorded)
    with folder.publishing() as staging:

        def write(name: str, writer: Callable[..., object], *content: Any, **options: Any) -> None:
            if name not in left_out:
                writer(staging.folder / name, *content, **options)

        write("trace.csv", result.trace.to_csv)
        result.write_more(staging.folder, shown)
        _write_chart(result, shown, write)
        if result.fitted is not None:
            write(
                "fitted.glb", write_glb, result.fitted.vertices, result.fitted.faces, result.fitted.uv, shown
            )
            moves = _linear_moves(result.linear_model)
            vertices, faces = result.fitted.template_vertices, result.fitted.model.template_faces
            if result.template is not None:
                write_template(staging.folder, result.template, deep, exr=exr, **moves)
            elif vertices is not None and faces is not None:
                write("template.obj", write_obj, vertices, faces)
                if moves:
                    write("template.glb", write_textured_glb, TexturedMesh(vertices, faces, **moves))
        if result.maps_of_skin is not None:
            write_template(staging.folder, result.maps_of_skin, np.uint16, exr=exr, stem="maps")
        if result.unlit is not None:
            write_unlit(staging.folder, result.unlit, deep, exr=exr)
        _write_places(result, write)
        if "overview.png" not in left_out:
            unlit = None if result.unlit is None else result.unlit.scan
            panels = result_panels(result.scan, result.fitted, image, estimate, preview, unlit)
            overview = figure_png(overview_figure(result.summary(), panels, columns=6))
            write("overview.png", Path.write_bytes, overview)
            write("error_vs_time.png", Path.write_bytes, figure_png(result.trace.plot(), dpi=110))
        own = None if result.fitted is None else result.fitted.model.template_from_model
        staging.write_record(
            name=result.scan.name,
            seed=result.seed,
            options=dict(result.options),
            input=InputRecord.of(result.scan, result.source, result.input_sha256),
            plan=tuple(result.plan),
            metrics=result.metrics(),
            lights=() if estimate is None else tuple(estimate.lights),
            environment=None if estimate is None else estimate.environment,
            parameters={} if estimate is None else estimate.parameters,
            timings_s=dict(result.timings_s),
            notes=result.notes,
            template_from_model=None if own is None else own.tolist(),
        )
    return folder.path


def _write_chart(result: ProcessResult, shown: ByteArray | None, write: Callable[..., None]) -> None:
    """Write what lies on the chart; `shown` (H, W, 3) is the albedo as it is shown."""
    image, estimate = result.geometry_image, result.albedo
    for name, values in result.maps.items():
        write(name, write_png, gray_bytes(values))
    write("geometry_image.npz", write_geometry_image, image)
    write("geometry_image.exr", write_geometry_image_exr, image)
    if image.skin is not None:
        write("skin.png", write_png, gray_bytes(np.where(image.mask, image.skin, 0)))
    if image.labels is not None:
        write("labels.png", write_indexed_png, image.labels)
    if estimate is not None and shown is not None:
        seen = np.where(image.seen, np.uint8(255), np.uint8(0))
        write("albedo.exr", write_exr, estimate.albedo_linear)
        write("albedo.png", write_png, np.dstack([shown, seen]))
        if estimate.expected_error is not None:
            write("expected_error.exr", write_exr, estimate.expected_error)
        write("shading.exr", write_exr, estimate.shading)
        write("specular.exr", write_exr, estimate.specular)
        write("shadow.png", write_png, gray_bytes(estimate.shadow))


def _linear_moves(linear: LinearModelFit | None) -> Values:
    """Return how a linear model's mesh moves, as a `TexturedMesh` has it; nothing where it has no names."""
    if linear is None or not linear.model.names:
        return {}
    return dict(zip(("rest", "targets", "weights"), linear.neutral_and_targets(), strict=True))


def _write_places(result: ProcessResult, write: Callable[..., None]) -> None:
    """Write the pose, the coefficients of a linear model and the landmarks, in the scan's own frame."""
    fitted, linear, registration = result.fitted, result.linear_model, result.registration
    if fitted is not None and linear is not None:
        placed = np.diag([*np.ones(3) / result.scan.mm_per_unit, 1]) @ invert_rigid(fitted.model_from_scan)
        write("coefficients.json", write_record, linear.record(placed))
        arrays = {
            "vertices": transform_points(placed, linear.vertices),
            "faces": linear.model.faces,
            "residual_mm": linear.residual_mm,
            "displacement_mm": linear.displacement_mm,
        }
        write("linear_model.npz", write_npz, arrays, what="linear model")
    if registration is not None:
        poses = RegistrationRecord(
            model_from_scan=registration.model_from_scan.tolist(),
            fitted_from_scan=None if fitted is None else fitted.model_from_scan.tolist(),
            rmse_mm=registration.rmse_mm,
            depth_error=registration.depth_error,
            converged=registration.converged,
            confidence=registration.confidence,
            iterations=registration.iterations,
        )
        write("registration.json", write_record, poses)
    in_scan = result.landmarks_scan
    deviation_mm = None if fitted is None else fitted.landmark_deviation_mm
    if fitted and fitted.landmarks is not None and in_scan is not None and deviation_mm is not None:
        landmarks = LandmarksRecord.of(fitted.landmarks, in_scan, deviation_mm, result.scan.mm_per_unit)
        write(LANDMARKS_FILE, write_record, landmarks)
        write("landmarks.csv", write_landmarks_csv, landmarks)
