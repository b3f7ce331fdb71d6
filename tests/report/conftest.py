"""Folders of results, made without the pipeline: its files are what a report stands on."""

import shutil
from functools import cache, partial

import numpy as np
import pytest
from PIL import Image

from scan2albedo.core.plan import PlanStep
from scan2albedo.io.geometry_image_files import write_geometry_image
from scan2albedo.io.images import write_exr
from scan2albedo.io.records import write_record
from scan2albedo.io.result_records import InputRecord, ResultRecord
from scan2albedo.synthetic import Material, face, hemisphere, light_at

MATERIAL = Material(0.3, 0.15, 20.0)
LIGHTS = (light_at(35, 20, intensity=2.0), light_at(-50, 5, intensity=0.8))


@cache
def _scene(size):
    """A face, or in few texels a hemisphere, which is made at once."""
    make = hemisphere if size < 64 else partial(face, 0)
    return make(size=size, material=MATERIAL, bits=None, lights=list(LIGHTS))


def _record(name, **changes):
    fields = {
        "scan2albedo_version": "0.1.0",
        "versions": {},
        "name": name,
        "seed": 0,
        "options": {"model": "none", "size": 32, "unit": "auto", "skip": []},
        "input": InputRecord(sha256="0" * 64, vertices=10, faces=20),
        "plan": (
            PlanStep(stage="fit", ran=False, reason="no model was asked for"),
            PlanStep(stage="albedo.shadows", ran=True, reason="it shades itself", evidence="at most 28 %"),
        ),
        "metrics": {
            "seconds": 12.5,
            "fit": {"residual_mean_mm": 0.125, "converged": True},
            "albedo": {
                "lights": 2,
                "expected_error": 0.037,
                "uncertainty": {
                    "direction_deviation_deg": [0.5, 1.25],
                    "intensity_deviation": [0.01, 0.02],
                    "albedo_deviation": 0.0123,
                    "alternatives": [{"lights_deg": [[-20.0, 5.0]], "excess": 0.693}],
                },
            },
        },
        "lights": LIGHTS,
        "parameters": {
            "ambient": 1.0,
            "brdf": "oren-nayar",
            "sigma_rad": MATERIAL.sigma_rad,
            "specular_strength": MATERIAL.specular_strength,
            "specular_exponent": MATERIAL.specular_exponent,
        },
        "timings_s": {"load": 0.001, "albedo": 12.499},
        "notes": (),
        "files": ("albedo.exr", "trace.csv", "overview.png", "result.json"),
    }
    return ResultRecord(**(fields | changes))


@pytest.fixture(scope="session")
def write_scan():
    """Write the files of a result: (folder, name, size, **fields of its record) -> folder."""

    def write(folder, name=None, size=32, **changes):
        folder.mkdir(parents=True, exist_ok=True)
        scene = _scene(size)
        write_geometry_image(folder / "geometry_image.npz", scene.image)
        write_exr(folder / "albedo.exr", scene.albedo_linear.astype(np.float32))
        Image.new("RGB", (60, 40), (200, 180, 160)).save(folder / "overview.png")
        (folder / "trace.csv").touch()
        shutil.copy(folder / "overview.png", folder / "error_vs_time.png")
        write_record(folder / "result.json", _record(name or folder.name, **changes))
        return folder

    return write


@pytest.fixture(scope="session")
def one_scan(write_scan, tmp_path_factory):
    return write_scan(tmp_path_factory.mktemp("one") / "anna")


@pytest.fixture(scope="session")
def some_scans(write_scan, tmp_path_factory):
    """Four scans of different residuals, and one whose result.json was cut short."""
    out = tmp_path_factory.mktemp("some")
    for k, residual in enumerate((0.1, 0.4, 0.2, 0.3)):
        metrics = {"seconds": 10.0 + k, "fit": {"residual_mean_mm": residual}}
        write_scan(out / f"scan-{k}", metrics=metrics)
    damaged = write_scan(out / "scan-9") / "result.json"
    damaged.write_text(damaged.read_text()[:200])
    return out
