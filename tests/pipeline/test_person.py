"""One shape and one albedo from several scans of a person."""

from dataclasses import replace

import pytest
from helpers.records import files_in, read_json

from scan2albedo import process_person, read_geometry_image
from scan2albedo.albedo import albedo_error
from scan2albedo.applications import load_result
from scan2albedo.errors import RegistrationError
from scan2albedo.io.images import read_image_linear
from scan2albedo.recognition import read_labelled_templates
from scan2albedo.synthetic import Scanner, light_at, raw_scan

LIGHTS = (
    light_at(-32, 18, distance_mm=900.0, intensity=2.5),
    light_at(45, 10, distance_mm=900.0, intensity=3.0),
    light_at(0, 50, distance_mm=900.0, intensity=2.0),
)


def scanned(seed, k, expression):
    scan, truth = raw_scan(seed, expression=expression, lights=[LIGHTS[k]], scanner=Scanner(size=256))
    return replace(scan, name=f"scan{k}"), truth.albedo_linear


def test_what_no_person_can_be_made_of_is_refused(tmp_path):
    for scans, options, words in (
        ([], {}, "no scan was given"),
        ([tmp_path / "a.obj", tmp_path / "x" / "a.ply"], {}, "several are called 'a'"),
        ([tmp_path / "a.obj"], {"model": "none"}, "a person needs the model of a face"),
        ([tmp_path / "a.obj"], {"name": "../x"}, r"name is '\.\./x'"),
    ):
        with pytest.raises(ValueError, match=words):
            process_person(scans, **options)
    with pytest.raises(RegistrationError, match=r"ann: no scan can be used: .*missing.obj"):
        process_person([tmp_path / "missing.obj"], tmp_path / "out", name="ann")
    assert not (tmp_path / "out" / "ann").exists()


@pytest.mark.slow
def test_scans_of_a_person_in_other_lights_and_expressions(tmp_path):
    (first, truth), (second, _) = scanned(3, 0, "neutral"), scanned(3, 1, "smile")
    third, stranger = scanned(3, 2, "frown")[0], scanned(8, 2, "neutral")[0]
    broken = tmp_path / "broken.obj"
    broken.write_text("no mesh\n")
    lost = "texture skin.png is missing: went on without it"
    second = replace(second, notes=(*second.notes, lost))
    scans = [first, second, third, replace(stranger, name="stranger"), broken]
    person = process_person(scans, tmp_path, name="ann", quality="draft")
    out = tmp_path / "ann"
    assert person.members == ("scan0", "scan1", "scan2")
    assert [name for name, _ in person.left_out] == ["broken", "stranger"]
    assert "another person" in dict(person.left_out)["stranger"]
    assert {"broken", "stranger"} <= {word for note in person.notes for word in note.split()}
    assert f"scan1: {lost}" in " ".join(person.notes)
    common = person.common
    seen = (common.coverage > 1) & (truth.max(-1) > 0) & (person.geometry_image.skin > 0.5)
    albedos = [read_image_linear(out / name / "albedo.exr") for name in person.members]
    together, *alone = (
        albedo_error(albedo, truth, seen).relative_rmse for albedo in (common.albedo_linear, *albedos)
    )
    assert together < 1.05 * min(alone), alone
    assert person.shape.expression.shape[0] == 3
    record = read_json(out / "result.json")
    assert record["metrics"]["person"]["left_out"].keys() == {"broken", "stranger"}
    names = {"albedo.exr", "expected_error.exr", "coverage.png", "disagreement.png", "fitted.glb"}
    assert names <= files_in(out)
    assert read_geometry_image(out / "geometry_image.npz").texture_linear is not None
    assert load_result(out).has_albedo
    gallery = tmp_path / "gallery.csv"
    gallery.write_text(f"person,result\nann,{out}\nann,{out / 'scan0'}\n")
    assert len(read_labelled_templates(gallery)) == 2
