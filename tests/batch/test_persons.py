"""Faces and persons as tasks of a batch: real scans of the package's own faces."""

import os

import pytest
from worlds.files import write_obj

from scan2albedo.batch import load_albedos, load_catalogue, run_batch
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.synthetic import Scanner, light_at, raw_scan


@pytest.mark.slow
def test_persons_and_a_face_reach_the_catalogue_and_numpy(tmp_path):
    scanner = Scanner(size=64, picture_size=256, spacing_mm=4.0)
    rows = ["person,name,scan", "ann,broken,none.obj"]
    for person, seed in (("ann", 3), ("bob", 8)):
        for k, side in enumerate((-30, 40)):
            lamp = light_at(side, 15, distance_mm=900.0, intensity=2.5)
            write_obj(raw_scan(seed, lights=(lamp,), scanner=scanner)[0], tmp_path / f"{person}{k}.obj")
            rows.append(f"{person},day{k},{person}{k}.obj")
    manifest, out = tmp_path / "people.csv", tmp_path / "out"
    manifest.write_text("\n".join([*rows, ",face,bob0.obj"]))

    def processed():
        options = ProcessOptions(quality="draft", size=64, pictures=False)
        return run_batch(manifest, out, options=options, jobs=1, resume=True)

    report = processed()
    assert (report.progress.total, report.progress.done) == (3, 3), report.failures
    ann, bob, face = load_catalogue(out).to_pylist()
    assert ann["person"] == "ann"
    assert "broken" in ann["notes"]
    assert bob["metrics_person_deviation_mm"] > 0
    assert face["model"] == "default annotated face model"
    assert face["metrics_fit_residual_mean_mm"] < 1.0
    assert face["metrics_albedo_lights"] >= 1
    assert 300 < face["peak_memory_mb"] < 5000
    assert face["cpu_seconds"] > 0
    assert face["path_fitted_glb"] == "face/fitted.glb"
    assert f":{os.getpid()}" not in face["worker"]
    names, albedo_linear, masks = load_albedos(out, 32)
    assert names == ["ann", "bob", "face"]
    assert 0.02 < albedo_linear[masks].mean() < 1.5
    for name in ("ann/day0", "ann/day1", "bob/day1"):
        assert (out / name / "albedo.exr").is_file()
    kept = processed()
    assert kept.progress.kept == 3
    assert kept.files_verified > 40
    lost = out / "bob" / "day1" / "albedo.exr"
    lost.unlink()
    assert processed().progress.kept == 2
    assert lost.is_file()
