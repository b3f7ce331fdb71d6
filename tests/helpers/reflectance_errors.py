"""How far reflectances found are from the truth."""

from bench.judging import relative_rmse


def diffuse_error(fit, capture):
    """Return the relative error of the albedo of a fit where it is known."""
    known = fit.reflectance.known
    return relative_rmse(fit.reflectance.diffuse_linear[known], capture.truth.diffuse_linear[known])
