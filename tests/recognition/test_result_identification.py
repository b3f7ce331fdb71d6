"""Galleries and probes from files: right persons, one chart, clear words."""

import shutil
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from scan2albedo.errors import RecognitionError
from scan2albedo.io.geometry_image_files import read_geometry_image, write_geometry_image
from scan2albedo.io.images import write_exr
from scan2albedo.recognition import (
    TemplateOptions,
    cw_ssim,
    identify_results,
    read_face,
    read_labelled_templates,
    read_manifest,
    write_labelled_templates,
)
from scan2albedo.recognition.templates import NothingToCompareError
from scan2albedo.synthetic import face

OPTIONS = TemplateOptions(size=64)
identified = partial(identify_results, options=OPTIONS)


def known_names(found):
    """The persons on the probes that count in the rates."""
    return tuple(np.array(found.matches.probe_names)[found.matches.known])


def texels(top, bottom, left, right):
    """The texels (64, 64) of a rectangle."""
    chosen = np.zeros((64, 64), bool)
    chosen[top:bottom, left:right] = True
    return chosen


def listed(folder, rows, name="list.csv"):
    path = folder / name
    path.write_text("".join(f"{person},{result}\n" for person, result in [("person", "result"), *rows]))
    return path


@pytest.fixture
def gallery(people, tmp_path):
    return listed(tmp_path, [(name, people / name) for name in ("cy", "ann", "bob")], "gallery.csv")


@pytest.fixture
def probes(people, tmp_path):
    rows = [("bob", people / "bob-2"), ("", people / "ann-2"), ("cy", people / "cy-2")]
    return listed(tmp_path, rows, "probes.csv")


def test_persons_are_recognised_and_unknown_ones_only_predicted(gallery, probes, people):
    counts = []
    found = identified(gallery, probes, on_count=lambda *count: counts.append(count))
    assert found.matches.predicted == ("bob", "ann", "cy")
    assert found.matches.ranks.tolist() == [1, 0, 1]
    assert known_names(found) == ("bob", "cy")
    assert found.probes.labels[1] == str(people / "ann-2")
    assert found.notes == ()
    assert counts == [(stage, k, 3) for stage in ("gallery", "probes") for k in (1, 2, 3)]


def test_a_gallery_kept_in_a_file_gives_the_same(gallery, probes, tmp_path):
    kept = read_labelled_templates(gallery, options=OPTIONS)
    written = write_labelled_templates(tmp_path / "gallery.npz", kept)
    kinds = ("texture", "shape", "shading")
    assert [file.name for file in written] == ["gallery.npz", *(f"gallery.{kind}.npz" for kind in kinds)]
    first, again = identify_results(kept, probes), identify_results(tmp_path / "gallery.npz", probes)
    assert_array_equal(first.matches.similarities, again.matches.similarities)
    assert again.gallery.labels == ("cy [0]", "ann [1]", "bob [2]")
    assert set(again.by_kind) == {"albedo", *kinds}
    assert again.decided_by == first.decided_by
    for file in written[1:3]:
        file.unlink()
    alone = identify_results(tmp_path / "gallery.npz", probes)
    assert set(alone.by_kind) == {"albedo"}
    assert "gallery.npz: holds no texture" in alone.notes[0]
    with pytest.raises(RecognitionError, match=r"gallery\.npz was made with .*size=64.*size=32"):
        read_labelled_templates(tmp_path / "gallery.npz", options=TemplateOptions(size=32))


def test_several_images_of_a_person_are_combined(people, probes, tmp_path):
    rows = [(name, people / f"{name}{end}") for name in ("ann", "bob", "cy") for end in ("", "-2")]
    both = listed(tmp_path, rows, "both.csv")
    best, mean = (identified(both, probes, combine=c) for c in ("best", "mean"))
    assert_array_equal(identified(both, probes).matches.similarities, mean.matches.similarities)
    assert best.by_kind["albedo"].max(1).min() > 0.999
    assert (mean.matches.similarities.max(1) < best.matches.similarities.max(1)).all()
    assert "3 of 3 probes are in the gallery themselves" in best.notes[0]
    with pytest.raises(ValueError, match="combine is 'worst'"):
        identify_results(both, probes, combine="worst")


def test_sizes_and_models_have_to_agree(stored, people, tmp_path, probes):
    stored(tmp_path / "small", 0, size=32)
    stored(tmp_path / "other", 0, model="mine")
    for name, words in (
        ("small", "64 x 64 texels of model 'default' and .*line 3: small 32 x 32 .*--size"),
        ("other", "model 'default' and .*line 3: other 64 x 64 texels of model 'mine'.*--model"),
    ):
        rows = [("ann", people / "ann"), ("bob", name)]
        small = TemplateOptions(size=32)
        with pytest.raises(RecognitionError, match=words):
            identify_results(listed(tmp_path, rows), probes, options=small)
        alone = listed(tmp_path, [("bob", name)], "alone.csv")
        with pytest.raises(RecognitionError, match=r"alone\.csv has .* and .*probes\.csv"):
            identify_results(alone, probes, options=small)


def test_images_of_a_chart_nobody_named_go_with_any_model(people, tmp_path, probes):
    write_exr(tmp_path / "ann.exr", face(0, size=64).albedo_linear)
    rows = [("ann", "ann.exr"), ("bob", people / "bob"), ("cy", people / "cy")]
    found = identified(listed(tmp_path, rows), probes)
    assert found.matches.predicted == ("bob", "ann", "cy")
    assert found.gallery.templates.chart.model == "default"


def test_errors_of_the_albedo_are_weights(people, tmp_path):
    folder = shutil.copytree(people / "bob-2", tmp_path / "bob")
    seen = read_face(folder).certainty > 0
    error = np.full((64, 64), 0.1, np.float32)
    error[:32] = 0.9
    write_exr(folder / "expected_error.exr", error)
    for kind in ("albedo", "texture", "shading"):
        certainty = read_face(folder, kind).certainty
        assert_array_equal(certainty > 0, seen)
        low, high = (half[half > 0] for half in np.split(certainty, 2))
        assert 0 < low.max() < 0.3 < 0.7 < high.min() < 1


def test_images_without_a_record_are_a_result(people, gallery, tmp_path):
    """A person's common albedo, from several scans, needs geometry image and albedo alone."""
    folder = shutil.copytree(people / "bob-2", tmp_path / "common" / "bob")
    (folder / "application.json").unlink()
    found = identified(gallery, tmp_path / "common")
    assert found.matches.predicted == ("bob",)
    assert found.probes.templates.chart.model is None


def test_a_gallery_of_no_templates_is_refused(gallery):
    known = read_labelled_templates(gallery, options=OPTIONS)
    with pytest.raises(RecognitionError, match=r"gallery\.csv: holds no template"):
        identify_results(replace(known, sets={}, rows={}), known)


def test_what_cannot_be_read_is_named_with_its_line(gallery, people, tmp_path):
    (tmp_path / "empty").mkdir()
    rows = [("bob", people / "bob-2"), ("ann", "empty")]
    with pytest.raises(RecognitionError, match=r"list\.csv, line 3: empty: .*holds no result\.json"):
        identified(gallery, listed(tmp_path, rows))


def test_command_and_function_give_one_number(people, stored, tmp_path):
    stored(tmp_path / "ann", 0, hidden=texels(20, 40, 30, 50))
    gallery, probes = listed(tmp_path, [("ann", "ann")]), listed(tmp_path, [("ann", people / "ann")], "p.csv")
    shown, known = read_face(people / "ann"), read_face(tmp_path / "ann")
    expected = cw_ssim(shown.values, known.values, shown.certainty > 0, mask_b=known.certainty > 0)
    for options in ({"use": ["albedo"]}, {}):
        found = identify_results(gallery, probes, **options)
        assert found.by_kind["albedo"][0, 0] == pytest.approx(expected, abs=1e-5)


def test_a_folder_of_results_is_a_gallery_and_whom_it_does_not_know_is_named(people, stored, tmp_path):
    for seed, name in enumerate(("ann", "bob", "cy")):
        stored(tmp_path / "nested" / name / "monday", seed, noise=3)
    (tmp_path / "nested" / ".batch").mkdir()
    found = identified(tmp_path / "nested", people)
    assert found.gallery.labels == ("ann/monday", "bob/monday", "cy/monday")
    assert found.matches.predicted == ("ann", "ann", "bob", "bob", "cy", "cy")
    assert known_names(found) == ("ann", "bob", "cy")
    assert found.probes.persons == ("ann", "ann-2", "bob", "bob-2", "cy", "cy-2")
    with pytest.raises(RecognitionError, match=r"ann: is one result"):
        identify_results(people / "ann", people)


def test_persons_of_a_batch_come_from_its_catalogue(people, tmp_path):
    parquet, pyarrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    folder = shutil.copytree(people, tmp_path / "out")
    rows = {"name": ["ann", "ann-2", "bob", "cy"], "person": ["Ann", "Ann", "Bob", None]}
    parquet.write_table(pyarrow.table(rows), folder / "catalogue.parquet")
    probes = read_manifest(folder, persons_required=False)
    assert [entry.person for entry in probes.entries] == ["Ann", "Ann", "Bob", None, None, None]
    gallery = read_manifest(folder)
    assert [entry.person for entry in gallery.entries] == ["Ann", "Ann", "Bob", "bob-2", "cy", "cy-2"]


def test_a_persons_common_albedo_has_no_texture(people, tmp_path, monkeypatch):
    folder = shutil.copytree(people / "ann", tmp_path / "out" / "ann")
    (folder / "result.json").write_text("{}")
    metrics = {}
    record = SimpleNamespace(options={"model": "default"}, metrics=metrics)
    monkeypatch.setattr("scan2albedo.recognition.manifest.read_record", lambda *given: record)
    albedo = read_face(folder).values
    assert read_face(folder, "texture").values.shape == albedo.shape
    metrics["person"] = {"scans": ["a", "b"]}
    assert_array_equal(read_face(folder).values, albedo)
    for kind in ("texture", "shading"):
        with pytest.raises(NothingToCompareError, match="has no texture of its own"):
            read_face(folder, kind)


def test_scans_without_colour_are_recognised_by_shape(people, tmp_path, gallery):
    gray = shutil.copytree(people / "bob-2", tmp_path / "gray")
    (gray / "albedo.exr").unlink()
    image = replace(read_geometry_image(gray / "geometry_image.npz"), texture_linear=None)
    write_geometry_image(gray / "geometry_image.npz", image)
    probes = listed(tmp_path, [("bob", "gray"), ("cy", people / "cy-2")], "probes.csv")
    found = identified(gallery, probes)
    assert found.matches.predicted == ("bob", "cy")
    assert np.isnan(found.by_kind["albedo"][0]).all()
    assert found.notes[0].startswith(f"{probes}: 1 of 2 results have no albedo; the first: {probes}, line 2")
    assert "the scan has no colour" in found.notes[0]
    mixed = listed(tmp_path, [("bob", "gray"), ("cy", people / "cy")], "mixed.csv")
    found = identified(mixed, listed(tmp_path, [("cy", people / "cy-2")], "one.csv"))
    assert found.decided_by == ("shape",)
    write_exr(tmp_path / "ann.exr", face(0, size=64).albedo_linear)
    images = listed(tmp_path, [("ann", "ann.exr")], "images.csv")
    found = identified(images, probes)
    assert "probes.csv: gray: no window of 5 x 5" in found.notes[-1]
    found = identified(gallery, probes, use=["albedo"])
    assert (found.probes.labels, found.matches.predicted) == ((str(people / "cy-2"),), ("cy",))
    whole = tmp_path / "all"
    shutil.copytree(gray, whole / "gray")
    shutil.copytree(people / "cy-2", whole / "cy")
    for source, named in ((whole, whole / "gray"), (probes, f"{probes}, line 2: gray")):
        notes = read_labelled_templates(source, use=["albedo"], options=OPTIONS).notes
        assert notes[-1].startswith(f"left out: {named}: ")
        assert notes[-1].endswith("has no albedo, for the scan has no colour; compare by shape")
    only = listed(tmp_path, [("bob", "gray")], "only.csv")
    with pytest.raises(RecognitionError, match="no result has albedo to compare; the first: "):
        identify_results(gallery, only, use=["albedo"])


def test_results_without_a_window_are_left_out(people, stored, tmp_path, gallery, monkeypatch):
    stored(tmp_path / "masked", 0, hidden=texels(0, 64, 0, 64))
    stored(tmp_path / "narrow", 0, hidden=~texels(28, 36, 28, 36))
    rows = [("bob", people / "bob-2"), ("ann", "masked"), ("ann", "narrow")]
    monkeypatch.setattr("scan2albedo.recognition.templates.HOLE_RADIUS", 0)
    found = identified(gallery, listed(tmp_path, rows))
    assert found.matches.predicted == ("bob",)
    assert "line 3: masked: masked is masked everywhere" in found.notes[-2]
    assert "list.csv: narrow: no window of 5 x 5 coefficients lies inside the mask" in found.notes[-1]
    with pytest.raises(
        RecognitionError, match=r"no result has .*shape.* to compare.*masked is masked everywhere"
    ):
        identified(gallery, listed(tmp_path, rows[1:2]))
    with pytest.raises(RecognitionError, match=r"narrow: no window of 5 x 5 .* and no result is left"):
        identified(gallery, listed(tmp_path, rows[2:]))


def test_halves_of_faces_that_do_not_meet_count_as_unlike(people, stored, tmp_path):
    stored(tmp_path / "left", 0, hidden=texels(0, 64, 28, 64))
    stored(tmp_path / "right", 1, hidden=texels(0, 64, 0, 36))
    rows = [("ann", "left"), ("bob", people / "bob")]
    found = identify_results(listed(tmp_path, rows), listed(tmp_path, [("bob", "right")], "p.csv"))
    assert found.matches.predicted == ("bob",)
    assert found.matches.similarities[0, 0] < found.matches.similarities[0, 1] - 100
    assert found.by_kind["albedo"][0, 0] == 0


@pytest.mark.parametrize("use", [(), ("colour",), ("albedo", "albedo"), "shape"])
def test_what_to_use_is_checked(gallery, probes, use):
    with pytest.raises(ValueError, match="expected one or more of albedo, texture, shape"):
        identify_results(gallery, probes, use=use)


def test_probes_of_one_person_are_one_probe(gallery, people, tmp_path):
    rows = [("bob", people / "bob-2"), ("", people / "ann-2"), ("bob", people / "bob"), ("", people / "cy-2")]
    probes = listed(tmp_path, rows, "several.csv")
    alone, together = (identified(gallery, probes, together=t) for t in (False, True))
    assert together.probes.labels[0] == f"{people / 'bob-2'}, {people / 'bob'}"
    assert together.probes.persons == ("bob", None, None)
    odds = alone.matches.similarities
    assert_allclose(together.matches.similarities, [odds[[0, 2]].mean(0), odds[1], odds[3]])
    assert_allclose(together.by_kind["albedo"][0], alone.by_kind["albedo"][[0, 2]].mean(0))
    assert together.matches.predicted == ("bob", "ann", "cy")
    assert len(together.decided_by) == 3
