"""Albedos of a batch as arrays, in two lines."""

import numpy as np
import pytest

from scan2albedo.batch import load_albedos
from scan2albedo.batch.catalogue import catalogue_table, write_catalogue
from scan2albedo.errors import BatchError
from scan2albedo.io.images import write_exr
from tests.batch.test_catalogue import SHA, manifest, row


@pytest.fixture
def batch_of(tmp_path):
    """Write a batch of albedos of a value, size and model each, whose left half was seen."""

    def written(**albedos):
        rows = {"failed": row("failed", "failed")}
        for name, (value, size, model) in albedos.items():
            (tmp_path / name).mkdir()
            write_exr(tmp_path / name / "albedo.exr", np.full((size, size, 3), value, np.float32))
            seen = np.zeros((size, size), bool)
            seen[:, : size // 2] = True
            np.savez(tmp_path / name / "geometry_image.npz", mask=np.ones_like(seen), texture_valid=seen)
            rows[name] = row(name, model=model, files={"albedo.exr": SHA})
        rows["colorless"] = row("colorless", model="m")
        names = ("failed", *albedos, "colorless", "never")
        write_catalogue(tmp_path / "catalogue.parquet", catalogue_table(manifest(tmp_path, *names), rows))
        return tmp_path

    return written


def test_several_models_and_missing_files_are_told(batch_of):
    with pytest.raises(BatchError, match="no scan of this batch has an albedo"):
        load_albedos(batch_of())
    out = batch_of(a=(0.25, 8, "m"), b=(0.5, 8, "none"))
    with pytest.raises(BatchError, match=r"several models \(m, none\)"):
        load_albedos(out)
    out = batch_of(c=(0.25, 8, "m"))
    (out / "c" / "geometry_image.npz").unlink()
    with pytest.raises(BatchError, match=r"geometry_image.npz cannot be read .*--resume"):
        load_albedos(out)


def test_albedos_of_scans_that_are_done(batch_of):
    names, albedo_linear, masks = load_albedos(batch_of(a=(0.25, 16, "m"), b=(0.5, 16, "m")))
    assert names == ["a", "b"]
    expected = np.full((2, 16, 16, 3), 0.25, np.float32)
    expected[1] = 0.5
    np.testing.assert_array_equal(albedo_linear, expected, strict=True)
    assert (masks.shape, masks.dtype) == ((2, 16, 16), bool)
    assert np.array_equal(masks[0, 0], np.arange(16) < 8)


def test_another_size_averages_what_was_seen(batch_of):
    out = batch_of(a=(0.25, 16, "m"), b=(0.5, 48, "m"))
    with pytest.raises(BatchError, match=r"b has \(48, 48\) texels, a \(16, 16\); give a size"):
        load_albedos(out)
    for size in (8, 16, 48):
        _, albedo_linear, masks = load_albedos(out, size)
        assert albedo_linear.shape == (2, size, size, 3)
        np.testing.assert_allclose(albedo_linear[0], 0.25, rtol=1e-5)
        assert np.array_equal(masks[:, 0], np.tile(np.arange(size) < size // 2, (2, 1)))


def test_texels_that_were_filled_do_not_reach_into_the_average(batch_of):
    out = batch_of(a=(0.25, 16, "m"))
    image = np.full((16, 16, 3), 9.0, np.float32)
    image[:, :8] = 0.25
    write_exr(out / "a" / "albedo.exr", image)
    _, albedo_linear, masks = load_albedos(out, 5)
    np.testing.assert_allclose(albedo_linear[masks], 0.25, rtol=1e-6)
    assert np.all(albedo_linear[0, :, -1] == 9.0)
