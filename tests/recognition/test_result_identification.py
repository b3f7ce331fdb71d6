"""Galleries and probes from files: right persons, one chart, clear words."""

import numpy as np
import pytest

from scan2albedo.errors import RecognitionError
from scan2albedo.io.images import write_exr
from scan2albedo.recognition import (
    TemplateOptions,
    albedo_templates,
    identify_results,
    read_labelled_templates,
    read_manifest,
    result_templates,
    similarity_matrix,
    write_templates,
)
from scan2albedo.synthetic import face

OPTIONS = TemplateOptions(size=64)


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
    found = identify_results(gallery, probes, options=OPTIONS, on_count=lambda *count: counts.append(count))
    assert found.matches.predicted() == ("bob", "ann", "cy")
    assert found.matches.ranks.tolist() == [1, 0, 1]
    assert found.matches.named.probe_names == ("bob", "cy")
    assert found.probes.labels[1] == str(people / "ann-2")
    assert found.notes == ()
    assert counts == [(stage, k, 3) for stage in ("gallery", "probes") for k in (1, 2, 3)]


def test_templates_are_those_of_the_texels_that_were_seen(stored, tmp_path):
    hidden = np.zeros((64, 64), bool)
    hidden[28:36, 10:40] = True
    stored(tmp_path / "ann", 0, hidden=hidden)
    made = result_templates(read_manifest(listed(tmp_path, [("ann", "ann")])), options=OPTIONS)
    scene = face(0, size=64)
    expected = albedo_templates(
        [scene.albedo_linear], ["ann"], masks=[scene.image.mask & ~hidden], options=OPTIONS
    )
    np.testing.assert_array_equal(made.coefficients, expected.coefficients)
    np.testing.assert_array_equal(made.mask, expected.mask)
    assert made.names == ("ann",)
    assert (made.chart.model, made.chart.shape) == ("default", (64, 64))


def test_a_gallery_kept_in_a_file_gives_the_same(gallery, probes, tmp_path):
    kept = read_labelled_templates(gallery, options=OPTIONS)
    write_templates(tmp_path / "gallery.npz", kept.templates)
    first, again = identify_results(kept, probes), identify_results(tmp_path / "gallery.npz", probes)
    np.testing.assert_array_equal(first.matches.similarities, again.matches.similarities)
    assert again.gallery.labels == ("cy [0]", "ann [1]", "bob [2]")
    with pytest.raises(RecognitionError, match=r"gallery\.npz was made with .*size=64.*size=32"):
        read_labelled_templates(tmp_path / "gallery.npz", options=TemplateOptions(size=32))


def test_several_images_of_a_person_are_combined(people, probes, tmp_path):
    rows = [(name, people / f"{name}{end}") for name in ("ann", "bob", "cy") for end in ("", "-2")]
    both = listed(tmp_path, rows, "both.csv")
    best, mean = (identify_results(both, probes, options=OPTIONS, combine=c) for c in ("best", "mean"))
    assert best.matches.similarity().min() > 0.999
    assert (mean.matches.similarity() < best.matches.similarity()).all()
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
        with pytest.raises(RecognitionError, match=words):
            identify_results(listed(tmp_path, rows), probes, options=TemplateOptions(size=32))
        alone = listed(tmp_path, [(person, name) for person in ("bob",)], "alone.csv")
        with pytest.raises(RecognitionError, match=r"alone\.csv has .* and .*probes\.csv"):
            identify_results(alone, probes, options=TemplateOptions(size=32))


def test_charts_of_sets_of_templates_have_to_agree(stored, people, tmp_path):
    stored(tmp_path / "other", 0, model="mine")
    sets = [
        result_templates(read_manifest(listed(tmp_path, [("ann", path)])), options=OPTIONS)
        for path in (people / "ann", tmp_path / "other")
    ]
    with pytest.raises(RecognitionError, match="'default' and the second 64 x 64 texels of model 'mine'"):
        similarity_matrix(*sets)


def test_images_of_a_chart_nobody_named_go_with_any_model(people, tmp_path, probes):
    write_exr(tmp_path / "ann.exr", face(0, size=64).albedo_linear)
    rows = [("ann", "ann.exr"), ("bob", people / "bob"), ("cy", people / "cy")]
    found = identify_results(listed(tmp_path, rows), probes, options=OPTIONS)
    assert found.matches.predicted() == ("bob", "ann", "cy")
    assert found.gallery.templates.chart.model == "default"


def test_whom_the_gallery_does_not_know_is_named(gallery, people, tmp_path):
    strangers = listed(tmp_path, [("zoe", people / "ann-2"), ("bob", people / "bob-2")])
    with pytest.raises(RecognitionError, match=r"ann-2 \(zoe\); add .* or leave their person empty"):
        identify_results(gallery, strangers, options=OPTIONS)


def test_what_cannot_be_read_is_named_with_its_line(gallery, people, tmp_path):
    (tmp_path / "empty").mkdir()
    rows = [("bob", people / "bob-2"), ("ann", "empty")]
    with pytest.raises(RecognitionError, match=r"list\.csv, line 3: empty: .*holds no result\.json"):
        identify_results(gallery, listed(tmp_path, rows), options=OPTIONS)
    with pytest.raises(RecognitionError, match=r"list\.csv, line 2: .*expected a square of 128 or more"):
        identify_results(listed(tmp_path, [("ann", people / "ann")]), gallery)
