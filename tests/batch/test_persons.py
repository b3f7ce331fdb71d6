"""Persons as tasks of a batch: real scans of the package's own faces."""

import threading
import time

import numpy as np
import pytest
from helpers.records import read_json
from worlds.files import write_obj

from scan2albedo.batch import load_albedos, load_catalogue, run_batch
from scan2albedo.batch.records import Layout
from scan2albedo.pipeline.options import ProcessOptions
from scan2albedo.synthetic import Scanner, light_at, raw_scan

DRAFT = ProcessOptions(quality="draft", size=64, pictures=False)


@pytest.mark.slow
def test_a_worker_is_killed_in_the_middle_of_a_person(tmp_path):
    psutil, distributed = pytest.importorskip("psutil"), pytest.importorskip("distributed")
    scanner = Scanner(size=64, picture_size=256, spacing_mm=4.0)
    rows = ["person,name,scan", "ann,broken,none.obj"]
    for person, seed in (("ann", 3), ("bob", 8)):
        for k, side in enumerate((-30, 40)):
            lamp = light_at(side, 15, distance_mm=900.0, intensity=2.5)
            write_obj(raw_scan(seed, lights=(lamp,), scanner=scanner)[0], tmp_path / f"{person}{k}.obj")
            rows.append(f"{person},day{k},{person}{k}.obj")
    manifest, layout, killed = tmp_path / "people.csv", Layout(tmp_path / "out"), []
    manifest.write_text("\n".join(rows))

    def kill_once():
        while layout.started_at("ann") is None:
            time.sleep(0.05)
        time.sleep(2.0)  # in the middle of its scans
        killed.append(read_json(layout.running / "ann")["pid"])
        psutil.Process(killed[0]).kill()

    def again():
        return run_batch(manifest, layout.out, options=DRAFT, jobs=1, resume=True)

    killer = threading.Thread(target=kill_once)
    killer.start()
    with distributed.LocalCluster(
        n_workers=1, processes=True, threads_per_worker=1, dashboard_address=None, silence_logs="CRITICAL"
    ) as cluster:
        report = run_batch(manifest, layout.out, options=DRAFT, scheduler=cluster.scheduler_address)
    killer.join()
    assert len(killed) == 1
    assert (report.progress.total, report.progress.done) == (2, 2), report.failures
    ann, bob = load_catalogue(layout.out).to_pylist()
    assert ann["person"] == "ann"
    assert str(killed[0]) not in ann["worker"]
    assert "broken" in ann["notes"]
    assert bob["metrics_person_deviation_mm"] > 0
    names, albedos, masks = load_albedos(layout.out)
    assert names == ["ann", "bob"]
    assert np.isfinite(albedos[masks]).all()
    for name in ("ann/day0", "ann/day1", "bob/day1"):
        assert (layout.out / name / "albedo.exr").is_file()
    kept = again()
    assert kept.progress.kept == 2
    assert kept.files_verified > 40
    (layout.out / "bob" / "day1" / "albedo.exr").unlink()
    assert again().progress.kept == 1
    assert (layout.out / "bob" / "day1" / "albedo.exr").is_file()
