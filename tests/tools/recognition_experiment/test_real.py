"""The experiment on a data set of one's own: who takes part, what is compared, what the tables hold."""

import csv
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from recognition_experiment import RecognitionExperimentOptions, real
from recognition_experiment.real import BOTH, SHAPE, compared, people_counted, processed
from recognition_experiment.real_report import carried_levels, table, write_real_report

from scan2albedo.batch import ProcessOptions
from scan2albedo.errors import RecognitionError
from scan2albedo.io.geometry_image_files import write_geometry_image
from scan2albedo.io.images import write_exr
from scan2albedo.synthetic import face, light_at

OPTIONS = RecognitionExperimentOptions(brdfs=("oren-nayar",), size=64)
ROWS = [(person, session) for person in ("ann", "bob", "cy") for session in ("may", "june")]


def keep_result(folder, seed, session, gray=False):
    """Write what recognition reads of a processed scan: of june, from another side, and grainy."""
    scene = face(seed, size=64, lights=[light_at(-40 if session == "may" else 40, 10)])
    grain = 1 + 0.03 * np.random.default_rng(seed).standard_normal((64, 64, 1)) * (session == "june")
    folder.mkdir(parents=True)
    image = replace(scene.image, texture_linear=None) if gray else scene.image
    write_geometry_image(folder / "geometry_image.npz", image)
    if not gray:
        write_exr(folder / "albedo.exr", scene.albedo_linear * grain)


@pytest.fixture
def manifest(tmp_path, monkeypatch):
    """A manifest whose scans count as processed; those of `failed` as failed."""
    file = tmp_path / "people.csv"
    lines = [f"{person},{session},{person}-{session}.obj,{session[:1]}-lamp" for person, session in ROWS]
    file.write_text("\n".join(["person,session,scan,light", *lines]))
    failed = {}
    monkeypatch.setattr(real, "run_batch", lambda *given, **options: SimpleNamespace(failures=failed))
    return SimpleNamespace(file=file, failed=failed, out=tmp_path / "scans")


def data_of(manifest, **options):
    return processed(manifest.file, manifest.out, ProcessOptions(), jobs=1, **options)


def test_the_gallery_is_the_first_scan_or_a_session(manifest):
    data = data_of(manifest)
    assert [scan.name for scan in data.gallery] == ["ann-may", "bob-may", "cy-may"]
    assert [scan.name for scan in data.probes] == ["ann-june", "bob-june", "cy-june"]
    assert {scan.session for scan in data_of(manifest, gallery="june").gallery} == {"june"}


def test_scans_that_failed_are_counted_and_named(manifest):
    manifest.failed |= {"cy-may": "no face was found"}
    data = data_of(manifest)
    assert people_counted(data) == "2 persons, 2 probes (2 of session june); 2 scans left out"
    assert data.failures == {"cy-may": "no face was found", "cy-june": "cy has no scan in the gallery"}
    manifest.failed |= {"bob-may": "no face was found"}
    with pytest.raises(RecognitionError, match=r"1 persons have a scan in the gallery .* cy-may: no face"):
        data_of(manifest)


def test_a_line_without_a_person_is_named(manifest):
    manifest.file.write_text("person,session,scan\nann,may,a.obj\n,june,b.obj\n")
    with pytest.raises(RecognitionError, match=r"line 3: b\.obj has no person or no session"):
        data_of(manifest)


def test_methods_are_compared_and_reported_by_condition(manifest, tmp_path):
    for number, (person, session) in enumerate(ROWS):
        keep_result(manifest.out / f"{person}-{session}", number // 2, session)
    found = compared(data_of(manifest), manifest.out, tmp_path / "albedos", OPTIONS)
    results = found.results()
    assert list(results) == [("all", "")]  # one session and one lamp of all probes are no other groups
    by_method = {result.method: result for result in results["all", ""]}
    for method in ("albedo, oren-nayar", SHAPE, BOTH):
        assert by_method[method].rank_1 == 1
    assert by_method["raw texture"].separation < by_method["albedo, oren-nayar"].separation
    assert np.isfinite(found.calibration("albedo, oren-nayar").covariance).all()
    write_real_report(results, found.data, tmp_path / "out")
    rows = list(csv.DictReader((tmp_path / "out" / "table.csv").read_text().splitlines()))
    assert [row["method"] for row in rows] == list(by_method)
    assert json.loads((tmp_path / "out" / "real.json").read_text())["left_out"] == {}
    text = table(results, found.data)
    assert "all probes: 3 probes, too few to tell much" in text
    assert "TAR" not in text  # 6 claims of impostors carry no false accept rate of 10 %
    for name in ("cmc.png", "roc.png", "conditions.png"):
        assert (tmp_path / "out" / name).stat().st_size > 5000


def test_scans_without_colour_are_compared_by_shape(manifest, tmp_path):
    for number, (person, session) in enumerate(ROWS):
        keep_result(manifest.out / f"{person}-{session}", number // 2, session, gray=True)
    found = compared(data_of(manifest), manifest.out, tmp_path / "albedos", OPTIONS)
    assert list(found.similarities) == [SHAPE]


def test_rates_are_told_where_claims_carry_them():
    assert carried_levels(9) == ()
    assert carried_levels(1000) == (0.1, 0.01, 0.001)
