"""Templates come back from their files bit for bit; files that hold something else say so."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.npz import cut, rewritten
from numpy.testing import assert_array_equal

from scan2albedo.errors import OutputError, RecognitionError
from scan2albedo.recognition import Chart, TemplateOptions, albedo_templates, read_templates, write_templates

OBJECT = np.array({"a": 1}, object)


@pytest.fixture
def templates(albedo, face_like_mask):
    images, masks = [albedo(0), albedo(1)], [face_like_mask, albedo(2)]
    options = TemplateOptions(size=100, unit_mean=False)
    return albedo_templates(images, ["Ann Ö", "bob"], masks=masks, options=options)


@pytest.fixture
def path(tmp_path, templates):
    """A file of them."""
    write_templates(tmp_path / "gallery.npz", templates)
    return tmp_path / "gallery.npz"


def test_templates_come_back(path, templates):
    back = read_templates(path)
    assert_array_equal(back.coefficients, templates.coefficients)
    assert_array_equal(back.mask, templates.mask)
    assert_array_equal(back.weight, templates.weight)
    assert back.names == templates.names
    assert back.options == templates.options
    for chart in (None, Chart(None, (128, 128)), Chart("mine", (256, 256))):
        write_templates(path, replace(templates, chart=chart))
        assert read_templates(path).chart == chart


def test_a_write_that_fails_leaves_the_old_file(path, templates, monkeypatch):
    before = path.read_bytes()

    def fail(file, array, **options):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array", fail)
    with pytest.raises(OutputError, match="No space left"):
        write_templates(path, templates.select([0]))
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(
    "spoil",
    [
        Path.unlink,
        cut,
        lambda path: rewritten(path, header=None),
        lambda path: rewritten(path, header=OBJECT),
    ],
)
def test_what_is_no_file_of_templates_is_named(path, spoil):
    spoil(path)
    with pytest.raises(RecognitionError, match=r"gallery\.npz cannot be read"):
        read_templates(path)


def test_headers_that_do_not_fit_are_named(path):
    with np.load(path) as file:
        header = json.loads(str(file["header"]))
    for change, complaint in (
        ({"format": "scan2albedo cameras"}, "format: "),
        ({"names": ["ann"]}, "do not fit"),
        ({"format_version": 1}, "format_version"),
        ({"options": header["options"] | {"scales": 4}}, "options.scales"),
        ({"options": header["options"] | {"hole_radius": 0.0}}, "options.hole_radius"),
        ({"options": {"size": 128}}, "options.unit_mean"),
    ):
        rewritten(path, header=np.array(json.dumps(header | change)))
        with pytest.raises(RecognitionError, match=complaint):
            read_templates(path)
    rewritten(path, header=np.array("no json"))
    with pytest.raises(RecognitionError, match="template_set"):
        read_templates(path)


def test_numbers_that_are_not_finite_are_found_when_read(path, templates):
    spoilt = templates.coefficients.copy()
    spoilt[1, 0, 5, 5] = np.nan
    rewritten(path, coefficients=spoilt)
    with pytest.raises(RecognitionError, match=r"template 1 \(bob\) is not finite"):
        read_templates(path)


def test_nothing_to_write_and_other_endings_are_refused(tmp_path, templates):
    with pytest.raises(RecognitionError, match="no template to write"):
        write_templates(tmp_path / "gallery.npz", templates.select([]))
    with pytest.raises(ValueError, match=r"\.npz"):
        write_templates(tmp_path / "gallery.json", templates)
