"""Jobs that memory does not carry are cut, and that is said."""

import cv2
import numpy as np
import pytest
from helpers.pictures import png_of

from scan2albedo.batch import execution
from scan2albedo.batch.execution import available_mb, job_limit, worker_mb


@pytest.fixture
def four_gb(monkeypatch):
    monkeypatch.setattr(execution, "available_mb", lambda: 4096.0)


def test_a_worker_for_512_texels_is_counted_with_about_as_much_as_was_measured():
    # `process` of a scan of 31,000 vertices with a texture of 1800 x 900 pixels was measured with 745 MB at
    # 512 texels and 1061 MB at 1024, of which texture and mesh make some 300 MB.
    assert 500 < worker_mb([], 512) < 745
    assert 800 < worker_mb([], 1024) < 1061


def test_a_templates_texture_counts():
    with_template = worker_mb([], 512, template=8192)
    assert 1500 < with_template - worker_mb([], 512) < 2048


def test_jobs_are_cut_and_the_user_is_told(four_gb, tmp_path):
    jobs, note = job_limit(16, worker_mb([], 512))
    assert jobs == 6
    assert note == "6 of 16 jobs: a worker may need 0.5 GB and 4.0 GB are available"
    assert job_limit(6, worker_mb([], 512)) == (6, "")
    assert job_limit(16, worker_mb([tmp_path / "missing.obj"], 512))[0] == 6


def test_a_texture_counts_by_its_pixels_and_a_mesh_by_its_bytes(four_gb, tmp_path):
    (tmp_path / "big.obj").write_text("mtllib big.mtl\n" + "v 0 0 0\n" * 250_000)
    (tmp_path / "big.mtl").write_text("newmtl skin\nmap_Kd big.png\n")
    mesh = worker_mb([tmp_path / "big.obj"], 512) - worker_mb([], 512)
    assert mesh == pytest.approx(48, abs=2)
    cv2.imwrite(str(tmp_path / "big.png"), np.zeros((2048, 4096), np.uint8))
    textured = worker_mb([tmp_path / "big.obj"], 512)
    # 8 million pixels: 33 million were measured to take 4.9 GB.
    assert textured - mesh - worker_mb([], 512) == pytest.approx(1280, abs=2)


def test_a_containers_limit_counts(monkeypatch, tmp_path):
    limit, used = tmp_path / "max", tmp_path / "current"
    monkeypatch.setattr(execution, "_CGROUP_FILES", ((str(limit), str(used)),))
    unlimited = available_mb()
    limit.write_text("max\n")
    used.write_text("0\n")
    assert available_mb() == pytest.approx(unlimited, rel=0.2)
    limit.write_text(f"{300 << 20}\n")
    used.write_text(f"{100 << 20}\n")
    assert available_mb() == 200.0
    used.write_text(f"{400 << 20}\n")
    assert available_mb() == 0.0
    assert job_limit(4, worker_mb([], 64))[0] == 1


def test_pictures_that_are_refused_leave_the_jobs_alone(four_gb, tmp_path):
    """A header of four billion pixels, or one that is damaged, is a scan that fails, not fewer jobs."""
    large = png_of(60_000, 60_000)
    for content in (large, large[:20], b"RIFF", b"\xff\xd8\xff", b"II*\0\xff\xff\xff\xff"):
        (tmp_path / "a.obj").write_text("mtllib a.mtl\n")
        (tmp_path / "a.mtl").write_text("newmtl skin\nmap_Kd a.png\n")
        (tmp_path / "a.png").write_bytes(content)
        assert job_limit(2, worker_mb([tmp_path / "a.obj"], 512))[0] == 2
