"""Albedos: random fields with the spectrum of natural images; synthetic persons as files of results."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.albedo_fields import build_albedo

from scan2albedo.io.geometry_image_files import write_geometry_image
from scan2albedo.io.images import write_exr
from scan2albedo.io.records import write_record
from scan2albedo.io.result_records import ApplicationRecord
from scan2albedo.synthetic import face


@pytest.fixture(scope="session")
def albedo():
    return build_albedo


scene_of = cache(face)


def write_stored(folder, seed, *, noise=0, model="default", size=64, hidden=None):
    """Write what recognition reads of a processed face: a synthetic person's true albedo, with noise."""
    scene = scene_of(seed, size=size)
    grain = 1 + 0.05 * np.random.default_rng([seed, noise]).standard_normal((size, size, 1))
    folder.mkdir(parents=True)
    seen = scene.image.mask if hidden is None else scene.image.mask & ~hidden
    write_geometry_image(folder / "geometry_image.npz", replace(scene.image, texture_valid=seen))
    write_exr(folder / "albedo.exr", scene.albedo_linear * (grain if noise else 1))
    record = ApplicationRecord(
        scan2albedo_version="0",
        name=folder.name,
        application="blend",
        inputs=(),
        options={},
        model=model,
        chart_mesh=True,
        casts_shadows=True,
        view_direction=(0, 0, 1),
        shadow_offset_mm=0,
        reflectance={},
    )
    write_record(folder / "application.json", record)
    return folder


@pytest.fixture(scope="session")
def stored():
    return write_stored


@pytest.fixture(scope="session")
def people(tmp_path_factory):
    """A folder of three persons, twice each: ann, ann-2, bob, bob-2, cy, cy-2."""
    root = tmp_path_factory.mktemp("people")
    for seed, name in enumerate(("ann", "bob", "cy")):
        write_stored(root / name, seed, noise=1)
        write_stored(root / f"{name}-2", seed, noise=2)
    return root
