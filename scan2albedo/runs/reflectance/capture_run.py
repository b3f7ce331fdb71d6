"""From a capture file to light of single flashes and to reflectance, and their files."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scan2albedo import reflectance
from scan2albedo.core import BudgetLike, OnProgress
from scan2albedo.core.arrays import SMALLEST, BoolArray, FloatArray, Texts, Values, attributes
from scan2albedo.errors import ReflectanceError, errors_of
from scan2albedo.geometry.mesh import vertex_components, vertex_normals
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.images import write_exr, write_png
from scan2albedo.io.units import MM_PER_UNIT, PLAUSIBLE_EXTENT_MM, largest_extent
from scan2albedo.reflectance import CaptureFiles, MeshReflectance, OlatImages, ReflectanceFitOptions
from scan2albedo.reflectance.point_light_lobes import tilted_normals
from scan2albedo.report import reflectance_views as views
from scan2albedo.report.overview import overview_picture
from scan2albedo.runs.reflectance import publishing

_DOUBTFUL_MISFIT = 1.25
"""Median of the misfit above which a note says so, as of normals that are off by two degrees."""


@dataclass(frozen=True)
class FittedCapture:
    """A fit to all pictures, and the error of one that left some out; None where there were too few."""

    capture: CaptureFiles
    olat: OlatImages
    samples: reflectance.VertexSamples
    fit: reflectance.ReflectanceFit
    held_out: BoolArray
    error: reflectance.RelightingError | None
    notes: Texts = ()


def write_olat(capture: CaptureFiles, out: Path) -> Values:
    """Write the light that each flash added as EXR pictures, one a pair, and a sheet; return the figures."""
    from skimage.util import montage

    with errors_of(f"capture {capture.path}", ReflectanceError):
        olat = capture.extract_olat()
    figures = {
        "pairs": len(olat),
        "saturated_share": olat.saturated.any(-1).mean(),
        "valid_share": olat.valid.all(-1).mean(),
        "pairs_left_out": [d.pair for d in olat.diagnostics if d.left_out],
    }
    options, notes = {"gamma": capture.content.gamma}, _notes_of_capture(capture, olat)
    with publishing(out, "olat", (capture.path,), options, figures, notes) as results:
        for number, linear in enumerate(olat.linear):
            write_exr(results.folder / f"olat_{number:03d}.exr", linear)
        # A sheet of all pictures in rows, small, as bright as their brightest percentile allows.
        step = max(1, -(-max(olat.linear.shape[1:3]) // 128))
        small = np.clip(olat.linear[:, ::step, ::step], 0, None)
        level = max(float(np.percentile(small, 99.7)), SMALLEST)
        small = np.where(olat.saturated[:, ::step, ::step], np.float32(level), small)
        lights = len(set(capture.rig.light.tolist()))
        columns = lights if len(small) % lights == 0 else min(11, len(small))
        rows = -(-len(small) // columns)
        shown = np.minimum(small / level, 1)
        sheet = montage(shown, fill=(0, 0, 0), grid_shape=(rows, columns), channel_axis=-1)
        write_png(results.folder / "olat.png", encode_srgb_bytes(sheet))
    return figures


def fit_capture(
    capture: CaptureFiles,
    *,
    options: ReflectanceFitOptions = ReflectanceFitOptions(),
    held_out_every: int = 10,
    budget: BudgetLike = None,
    on_progress: OnProgress = None,
) -> FittedCapture:
    """Read the pictures of a capture, fit its vertices, and test a fit without one of `held_out_every` pairs.

    With 0 none is tested; the result, and the `budget`, are of the fit to all pairs. Raises errors of
    `CaptureFiles.extract_olat`, `sample_vertices` and `fit_reflectance`. Where the file gives the strength of
    the flashes, albedos above 1 are impossible.
    """
    if capture.scale_known and options.most_albedo is None:
        options = replace(options, most_albedo=1.0)
    with errors_of(f"capture {capture.path}", ReflectanceError):
        olat = capture.extract_olat()
        mesh, distance_mm = (capture.vertices, capture.faces), capture.reference_distance_mm
        samples = reflectance.sample_vertices(olat, capture.rig, *mesh, reference_distance_mm=distance_mm)
        samples = replace(samples, lobes=capture.content.flash_strength * samples.lobes)
        fit = reflectance.fit_reflectance(samples, options=options, budget=budget, on_progress=on_progress)
    notes, error = [], None
    if not fit.converged:
        notes.append("the fit stopped before it had converged")
    # One of `held_out_every` pairs that can be used; none where fewer than four would remain.
    usable, held_out = np.flatnonzero(samples.valid.any((1, 2))), np.zeros(len(samples.light), bool)
    if held_out_every > 0 and len(usable) >= 5:
        step = min(held_out_every, len(usable))
        held_out[usable[step // 2 :: step]] = True
    if held_out.any():
        try:
            error = reflectance.relighting_error(samples, held_out, options=options)
        except ReflectanceError as cause:
            notes.append(f"the fit was not tested on pictures left out: {cause}")
    if fit.impossible.any():
        notes.append(
            f"{fit.impossible.sum()} vertices have an albedo above 1, which is impossible, and count as not "
            "identified: creases, or mesh, poses or flash_strength are off there"
        )
    # Signs that mesh, poses, masks or gamma do not fit the pictures.
    known, signs = fit.reflectance.known, []
    sigma = np.median(fit.normal_sigma_degrees[known]) if known.any() else 0.0
    misfit = np.nanmedian(fit.misfit) if np.isfinite(fit.misfit).any() else 0.0
    if sigma > 2:
        signs.append(f"the mesh's normals seem to be off by {sigma:.1f} degrees")
    if misfit > _DOUBTFUL_MISFIT:
        signs.append(f"residuals are {misfit:.1f} times the noise")
    if signs and error is not None:
        off, noise = 100 * error.relative_rmse, 100 * error.noise_part
        signs.append(f"pictures left out are predicted to {off:.0f} %, noise alone would be {noise:.0f} %")
    if signs:
        notes.append(
            f"{'; '.join(signs)}: mesh, poses or masks may be off; it may also come from a wrong gamma "
            f"(light is taken as value^{capture.content.gamma:g})"
        )
    notes += _notes_of_capture(capture, olat)
    return FittedCapture(capture, olat, samples, fit, held_out, error, tuple(notes))


def write_fit(done: FittedCapture, out: Path, options: Values) -> Values:
    """Write reflectance, trace, overview and relit pictures; returns figures as in `reflectance.json`."""
    capture, fit = done.capture, done.fit
    mesh = MeshReflectance(capture.vertices, capture.faces, fit.reflectance)
    known = fit.reflectance.known
    identified = fit.identified[known].mean(0) if known.any() else np.zeros(6)
    figures: Values = {
        "pairs": done.samples.valid.any((1, 2)).sum(),
        "pairs_of_capture": len(done.samples.light),
        "vertices": len(known),
        "known_vertices": known.sum(),
        "pictures_per_vertex_median": np.median(fit.pair_count),
        "identified_share": dict(zip(reflectance.PARAMETERS, identified, strict=True)),
        "misfit_median": np.nanmedian(fit.misfit) if np.isfinite(fit.misfit).any() else None,
        "normal_sigma_degrees_median": np.median(fit.normal_sigma_degrees[known]),
        "impossible_vertices": fit.impossible.sum(),
        "plan": [vars(step) for step in fit.plan],
    }
    figures |= attributes(fit, "level", "converged", "iterations", "light_gain")
    title = f"{figures['known_vertices']} of {figures['vertices']} vertices, {figures['pairs']} pairs"
    if done.error is not None:
        error = attributes(done.error, "relative_rmse", "noise_part", "psnr_db")
        figures["held_out"] = {"pairs": done.held_out.sum(), **error}
        title += f"; pictures left out: relative RMSE {100 * done.error.relative_rmse:.1f} %"
    with publishing(out, "fit", (capture.path,), options, figures, done.notes) as results:
        reflectance.write_reflectance(results.folder / "reflectance.npz", mesh, fit=fit)
        results.trace(fit.trace)
        results.picture("overview.png", overview_picture(title, views.reflectance_panels(mesh, fit)))
        if done.error is not None:
            relit = (
                f"photographs left out of the fit: relative RMSE {100 * done.error.relative_rmse:.1f} % at "
                f"vertices, {done.error.psnr_db:.1f} dB"
            )
            chosen, panels, pairs = np.flatnonzero(done.held_out), [], capture.pair_names()
            shown = np.linspace(0, len(chosen) - 1, min(4, len(chosen))).astype(int)
            for j in chosen[shown]:
                panels += views.relit_panels(pairs[j], *relit_pair(done, j), done.olat.valid[j])
            results.picture("relit.png", overview_picture(relit, panels, 6))
        write_colored_mesh(results.folder / "face.ply", mesh, fit.drawn)
    return figures


def write_colored_mesh(path: Path, mesh: MeshReflectance, drawn: BoolArray | None = None) -> None:
    """Write the mesh with its albedo as sRGB of the vertices, filled where not `drawn` (V,), as PLY."""
    import trimesh

    colors = np.round(255 * views.albedo_colors(views.filled_albedo(mesh, drawn))).astype(np.uint8)
    trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False).export(path)


def relit_pair(done: FittedCapture, pair: int) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return a flash's light (H, W, 3), that of the tested fit, and where it is known (H, W)."""
    assert done.error is not None
    capture, fit, rig = done.capture, done.error.fit, done.capture.rig
    normals = tilted_normals(vertex_normals(capture.vertices, capture.faces), fit.tilt)
    shown = replace(fit.reflectance, known=fit.drawn)
    linear = done.olat.linear[pair].astype(float)
    made, known = views.relit_picture(
        capture.vertices,
        capture.faces,
        normals,
        shown,
        camera=rig.cameras[pair],
        shape=linear.shape[:2],
        light=rig.light_positions[pair],
        reference_distance_mm=capture.reference_distance_mm,
    )
    return linear, capture.content.flash_strength * made, known


def _notes_of_capture(capture: CaptureFiles, olat: OlatImages) -> list[str]:
    """Return the caveats of a file without gamma, of the mesh's size, and of pairs of pictures."""
    content, (low, high), names = capture.content, PLAUSIBLE_EXTENT_MM, capture.pair_names()
    notes = [*gamma_notes(capture)]
    extent_mm = largest_extent(capture.vertices, vertex_components(len(capture.vertices), capture.faces))
    if not low <= extent_mm < high:
        extent = extent_mm / MM_PER_UNIT[content.unit]
        others = [f'"{name}"' for name, factor in MM_PER_UNIT.items() if low <= extent * factor < high]
        advice = f'give "unit": {" or ".join(others)}' if others else "correct the mesh"
        notes.append(
            f"{content.mesh} is {extent:.3g} {content.unit} long, and a head measures {low:g} to {high:g} "
            f"mm: if it is of a head, {advice}, and see that the translations and falloff_distance are in "
            "the same unit"
        )
    # Every capture has clipped highlights.
    faults = [one for one in olat.diagnostics if one.name != "saturated" or one.part > 0.05]
    return notes + [f"{names[one.pair]}: {one.message}" for one in faults]


def gamma_notes(files: CaptureFiles | reflectance.PhotographFiles) -> Texts:
    """Return the caveat of a file that gives no gamma, which is a guess then."""
    if "gamma" in files.content.model_fields_set:
        return ()
    return (
        f"{files.path.name} gives no gamma: light is taken as value^{files.content.gamma:g}; say "
        '"gamma": 1 for linear pictures, about 2.2 for ordinary sRGB pictures',
    )
