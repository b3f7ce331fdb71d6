"""The catalogue's columns and their types, the same for every batch."""

from __future__ import annotations

FIXED = {
    "name": "string",
    "source": "string",
    "status": "string",
    "reason": "string",
    "folder": "string",
    "model": "string",
    "input_sha256": "string",
    "options_sha256": "string",
    "seconds": "float64",
    "cpu_seconds": "float64",
    "peak_memory_mb": "float64",
    "worker": "string",
    "finished_at": "timestamp",
    "plan_ran": "string",
    "plan_skipped": "string",
    "notes": "string",
}
"""Columns of every scan."""

STAGES = ("load", "register", "fit", "geometry_image", "albedo", "files")
"""Stages that have a column of seconds."""

FILES = ("albedo.exr", "albedo.png", "geometry_image.npz", "fitted.glb", "result.json", "overview.png")
"""Files that have a column of paths."""

METRICS = {
    "metrics_seconds": "float64",
    "metrics_registration_rmse_mm": "float64",
    "metrics_registration_confidence": "float64",
    "metrics_registration_converged": "bool",
    "metrics_fit_residual_mean_mm": "float64",
    "metrics_fit_residual_median_mm": "float64",
    "metrics_fit_residual_p95_mm": "float64",
    "metrics_fit_coverage": "float64",
    "metrics_fit_flipped_faces": "float64",
    "metrics_fit_scale": "float64",
    "metrics_fit_converged": "bool",
    "metrics_geometry_image_coverage": "float64",
    "metrics_geometry_image_seen": "float64",
    "metrics_geometry_image_texel_area_mm2": "float64",
    "metrics_geometry_image_texel_area_p95_to_p5": "float64",
    "metrics_albedo_lights": "float64",
    "metrics_albedo_parameters_ambient": "float64",
    "metrics_albedo_parameters_sigma_rad": "float64",
    "metrics_albedo_parameters_specular_strength": "float64",
    "metrics_albedo_parameters_specular_exponent": "float64",
    "metrics_albedo_parameters_light_distance_mm": "float64",
    "metrics_albedo_converged": "bool",
    "metrics_albedo_uncertainty_albedo_deviation": "float64",
}
"""Figures of `ProcessResult.metrics` that have a column even where no scan has them."""


def path_column(file: str) -> str:
    """Return the column that holds the path of a file.

    >>> path_column("albedo.exr")
    'path_albedo_exr'
    """
    return f"path_{file.replace('.', '_')}"


def is_taken(name: str) -> bool:
    """Return whether a column of that name may be the catalogue's own."""
    folded = name.casefold()
    return folded in FIXED or folded.startswith(("metrics_", "seconds_", "path_"))
