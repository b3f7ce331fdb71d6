"""Named extremes: the fit stays finite, says what is wrong, or does not care."""

import numpy as np
import pytest

from scan2albedo.errors import FitError, ScanError
from scan2albedo.fitting import FitOptions, fit
from scan2albedo.geometry.rigid import compose
from scan2albedo.io.raw_scan import RawScan

QUICK = {"levels": (0, 1), "steps": 8, "rigid_iterations": 10, "result_levels": 1}


def run(mask_model, mask_scan, scan=None, budget=None, **options):
    fitted = fit(
        scan or mask_scan.scan, mask_model, np.eye(4), budget, options=FitOptions(**{**QUICK, **options})
    )
    assert np.isfinite(fitted.vertices).all()
    assert np.abs(fitted.vertices).max() < 300
    return fitted


@pytest.mark.parametrize("stiffness", [1e-6, 1e-3, 1.0, 1e4, 1e8])
def test_stiffness(mask_model, mask_scan, stiffness):
    bending, membrane = 10 * stiffness**0.25, stiffness**0.5
    run(mask_model, mask_scan, bending_mm=(bending, bending), membrane_mm=(membrane, membrane))


def test_no_stiffness_at_all(mask_model, mask_scan):
    run(mask_model, mask_scan, bending_mm=(0.0, 0.0), membrane_mm=(0.0, 0.0))


@pytest.mark.parametrize("time_step", [1e-6, 1e-3, 1.0, 1e3])
def test_time_step(mask_model, mask_scan, time_step):
    run(mask_model, mask_scan, time_step=time_step)


@pytest.mark.parametrize("mass", [1e-6, 1e6])
def test_mass(mask_model, mask_scan, mass):
    run(mask_model, mask_scan, mass=mass)


def test_a_scan_of_one_triangle(mask_model, mask_scan):
    tiny = RawScan(
        np.array([[0.0, 0, 30], [1, 0, 30], [0, 1, 30]]), np.array([[0, 1, 2]]), name="one triangle"
    )
    with pytest.raises(FitError, match="one triangle: only"):
        run(mask_model, mask_scan, tiny)


def test_slivers_and_coincident_vertices(mask_model, mask_scan):
    scan = mask_scan.scan
    rng = np.random.default_rng(0)
    doubled = np.concatenate([scan.vertices, scan.vertices + 1e-9])
    corner_from_copy = rng.random(scan.faces.shape) < 0.5
    faces = np.where(corner_from_copy, scan.faces + len(scan.vertices), scan.faces)
    slivers = np.column_stack([faces[:200, 0], faces[:200, 1], faces[:200, 0]])
    run(mask_model, mask_scan, RawScan(doubled, np.concatenate([faces, slivers])))


def test_a_tenth_of_the_vertices_lost(mask_model, mask_scan):
    scan = mask_scan.scan
    lost = np.random.default_rng(1).random(len(scan.vertices)) < 0.1
    fitted = run(mask_model, mask_scan, RawScan(scan.vertices, scan.faces[~lost[scan.faces].any(1)]))
    assert fitted.metrics["residual_median_mm"] < 1.0


def test_a_scan_with_a_tenth_of_its_vertices_nan_is_fitted_once_they_are_removed(mask_model, mask_scan):
    vertices, faces = mask_scan.scan.vertices.copy(), mask_scan.scan.faces
    vertices[np.random.default_rng(3).random(len(vertices)) < 0.1] = np.nan
    with pytest.raises(ScanError, match="NaN"):
        RawScan(vertices, faces)
    known = np.isfinite(vertices).all(1)
    left = RawScan(vertices[known], (np.cumsum(known) - 1)[faces[known[faces].all(1)]])
    fitted = run(mask_model, mask_scan, left)
    assert fitted.metrics["residual_median_mm"] < 1.0


def test_coincident_vertices_that_are_half_the_scan(mask_model, mask_scan):
    scan = mask_scan.scan
    vertices = scan.vertices.copy()
    odd = np.flatnonzero(np.arange(len(vertices) - 1) % 2)
    vertices[odd] = vertices[odd + 1]
    fitted = run(mask_model, mask_scan, RawScan(vertices, scan.faces))
    assert fitted.metrics["residual_median_mm"] < 1.0


@pytest.mark.parametrize("ratio", [1e-6, 1e6])
def test_a_mass_to_damping_ratio_of_a_million(mask_model, mask_scan, ratio):
    run(mask_model, mask_scan, mass=ratio**0.5, damping=ratio**-0.5)


@pytest.mark.parametrize("noise_mm", [1.0, 5.0])
def test_noise(mask_model, mask_scan, noise_mm):
    scan = mask_scan.scan
    noise = noise_mm * np.random.default_rng(2).normal(size=scan.vertices.shape)
    run(mask_model, mask_scan, RawScan(scan.vertices + noise, scan.faces))


@pytest.mark.parametrize("unit", [1e3, 1e-3, 1e-6], ids=["micrometres", "metres", "kilometres"])
def test_a_scan_in_another_unit_is_refused_with_the_reason(mask_model, mask_scan, unit):
    scan = mask_scan.scan
    with pytest.raises(FitError, match=r"unit|wrong|face"):
        run(mask_model, mask_scan, RawScan(unit * scan.vertices, scan.faces))


def test_a_scan_a_thousand_kilometres_from_its_origin(mask_model, mask_scan):
    scan, away = mask_scan.scan, np.array([1e6, -1e6, 1e6])
    plain = run(mask_model, mask_scan)
    far = fit(
        RawScan(scan.vertices + away, scan.faces),
        mask_model,
        compose(np.eye(3), -away),
        options=FitOptions(**QUICK),
    )
    np.testing.assert_allclose(far.vertices, plain.vertices, atol=0.02)


def test_a_scan_of_slivers(mask_model, mask_scan):
    scan = mask_scan.scan
    a, b, _ = scan.vertices[scan.faces].transpose(1, 0, 2)
    thin = np.concatenate([scan.vertices, a + 1e-6 * (b - a)])
    extra = np.column_stack([scan.faces[:, 0], len(scan.vertices) + np.arange(len(a)), scan.faces[:, 2]])
    run(mask_model, mask_scan, RawScan(thin, np.concatenate([scan.faces, extra])))


def test_a_budget_of_a_twentieth_of_a_second(mask_model, mask_scan):
    fitted = run(
        mask_model, mask_scan, budget=0.05, levels=(0, 0, 1, 1, 1, 1), steps=200, gain_tolerance=-1.0
    )
    assert not fitted.converged


def test_an_inside_out_scan_is_fitted_all_the_same(mask_model, mask_scan):
    scan = mask_scan.scan
    fitted = run(mask_model, mask_scan, RawScan(scan.vertices, scan.faces[:, ::-1]))
    plain = run(mask_model, mask_scan)
    gap = np.abs(fitted.vertices - plain.vertices)
    assert np.percentile(gap, 97) < 0.05
    assert gap.max() < 0.5
