"""What the builder of the traced set makes, and what it leaves as it is."""

from build_traced_scans import PEOPLE, is_wanted, timed


def test_files_that_exist_are_not_made_again(tmp_path):
    file = tmp_path / "soft_dome_anna.npz"
    assert is_wanted(file, [])
    assert is_wanted(file, ["soft_dome_anna"])
    assert not is_wanted(file, ["soft_sky_anna"])
    file.write_bytes(b"")
    assert not is_wanted(file, [])


def test_people_are_light_and_dark():
    tones = sorted(person.tone for person in PEOPLE)
    assert tones[0] < 0.2
    assert tones[-1] > 0.8


def test_times_are_told(capsys):
    with timed("soft_dome_anna"):
        pass
    assert capsys.readouterr().out.startswith("soft_dome_anna: 0 s")
