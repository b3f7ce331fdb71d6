"""A cache of scans that were never scanned: charts of synthetic faces, so that tests do not wait."""

import numpy as np
import pytest
from recognition_experiment import RecognitionExperimentOptions
from recognition_experiment.sessions import TEXTURE, Session, keep_session
from worlds.population import Population

from scan2albedo.synthetic import Scanner, face, light_at

PERSONS, SIZE = 4, 128


@pytest.fixture(scope="session")
def small_options():
    """Four persons, two probes, two reflectances; scans as coarse as they still register."""
    return RecognitionExperimentOptions(
        persons=PERSONS,
        probes=2,
        size=SIZE,
        brdfs=("oren-nayar", "lambert"),
        population=Population(scanner=Scanner(spacing_mm=3.5, picture_size=256, size=64), individuality=1.0),
    )


@pytest.fixture(scope="session")
def charts():
    """Sessions (person, scan) whose albedo is the true one, in the Lambert one with noise."""
    random, made = np.random.default_rng(0), {}
    for person in range(PERSONS):
        scene = face(person, size=SIZE, lights=[])
        albedo, normal, mask = scene.albedo_linear, scene.image.normal, scene.image.mask
        for scan in range(3):
            lit = 0.3 + np.maximum(normal @ light_at(*random.uniform(-60, 60, 2)).direction, 0)
            noisy = albedo * np.exp(0.02 * random.standard_normal(albedo.shape))
            images = {TEXTURE: albedo * lit[..., None], "oren-nayar": albedo, "lambert": noisy}
            half = {name: image.astype(np.float16) for name, image in images.items()}
            made[person, scan] = Session(half, mask)
    return made


@pytest.fixture
def filled_cache(tmp_path, small_options, charts):
    """Return a cache folder that holds all of the sessions."""
    for (person, scan), session in charts.items():
        keep_session(tmp_path, small_options, person, scan, session)
    return tmp_path
