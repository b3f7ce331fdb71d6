"""The experiment: every figure from the scans, resumed where it stopped, honest about what is missing."""

from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace

import numpy as np
import pytest
from recognition_experiment import (
    RecognitionExperimentOptions,
    experiment,
    run_recognition_experiment,
)
from recognition_experiment.methods import CHROMATICITY, method_image, method_names, unlit_chromaticity
from recognition_experiment.sessions import (
    Session,
    cached_session,
    keep_session,
    made_session,
    session_file,
)

from scan2albedo.core import Budget
from scan2albedo.errors import RecognitionError

pytestmark = pytest.mark.slow

BOTH = ("oren-nayar", "lambert")
FAILED = Session({}, np.zeros((128, 128), bool), "person-2-session-0: no face was found", BOTH)


def test_scans_that_are_there_are_not_made_again(filled_cache, small_options):
    report = run_recognition_experiment(filled_cache, options=small_options)
    assert len(report.trace) == 0
    assert report.converged
    assert report.persons == (0, 1, 2, 3)
    assert [result.method for result in report.results] == list(method_names(small_options))
    assert report.result("albedo, oren-nayar").rank_1 == 1.0
    assert report.result("albedo, lambert").identification.probe_names == tuple(
        f"{person:04d}" for person in range(4) for _ in range(2)
    )


def test_more_persons_begin_with_those_that_are_done(filled_cache, small_options, monkeypatch, charts):
    made = []

    def counted(options, person, scan):
        made.append((person, scan))
        return charts[person - 1, scan]

    monkeypatch.setattr("recognition_experiment.sessions.made_session", counted)
    report = run_recognition_experiment(filled_cache, options=replace(small_options, persons=5))
    assert made == [(4, 0), (4, 1), (4, 2)]
    assert report.persons == (0, 1, 2, 3, 4)
    # The fifth person is the fourth once more: they cannot be told apart.
    assert report.result("albedo, oren-nayar").rank_1 == pytest.approx(6 / 10)
    assert [row.evaluations for row in report.trace] == [3]


def test_a_budget_ends_it_and_the_next_run_goes_on(tmp_path, small_options, monkeypatch, charts):
    monkeypatch.setattr("recognition_experiment.sessions.made_session", lambda o, p, s: charts[p, s])
    with pytest.raises(RecognitionError, match="1 of 4 persons are complete"):
        run_recognition_experiment(tmp_path, options=small_options, budget=Budget(evaluations=4))
    report = run_recognition_experiment(tmp_path, options=small_options, budget=Budget(evaluations=3))
    assert report.persons == (0, 1)
    assert not report.converged
    assert "the budget ended" in report.table()
    whole = run_recognition_experiment(tmp_path, options=small_options)
    assert whole.persons == (0, 1, 2, 3)
    assert whole.converged
    assert [row.evaluations for row in whole.trace] == [2, 5]


def test_failed_scans_are_left_out_and_told(filled_cache, small_options):
    keep_session(filled_cache, small_options, 2, 0, FAILED)  # the gallery's: the person cannot take part
    keep_session(filled_cache, small_options, 3, 1, FAILED)  # a probe
    report = run_recognition_experiment(filled_cache, options=small_options)
    assert report.persons == (0, 1, 3)
    assert report.result("raw texture").identification.probe_names == ("0000", "0000", "0001", "0001", "0003")
    assert len(report.failures) == 2
    assert "2 scans failed" in report.table()


def test_what_failed_with_other_reflectances_is_tried_anew(filled_cache, small_options):
    keep_session(filled_cache, small_options, 2, 0, FAILED)
    assert cached_session(filled_cache, small_options, 2, 0).failure == FAILED.failure
    assert cached_session(filled_cache, replace(small_options, brdfs=("minnaert",)), 2, 0) is None


def test_a_ratio_of_channels_sees_no_light_that_is_white(small_options, charts):
    one, other = (method_image(CHROMATICITY, charts[0, scan], small_options) for scan in (0, 1))
    seen = charts[0, 0].seen
    textures = [charts[0, scan].images["texture"].astype(float)[seen] for scan in (0, 1)]
    assert np.abs(np.log(textures[0] / textures[1])).mean() > 0.1
    assert np.abs(np.log(one / other))[seen].mean() < 0.01


def test_red_over_green_of_an_albedo_is_that_of_a_texture_in_white_light(small_options, charts):
    unlit = method_image(unlit_chromaticity(small_options), charts[0, 0], small_options)
    lit = method_image(CHROMATICITY, charts[0, 0], small_options)
    assert np.abs(np.log(unlit / lit))[charts[0, 0].seen].mean() < 0.01


def test_a_worker_that_was_killed_is_told(tmp_path, small_options, monkeypatch):
    def killed(*arguments):
        raise BrokenProcessPool("gone")
        yield

    monkeypatch.setattr(experiment, "_made_in_processes", killed)
    with pytest.raises(RecognitionError, match="fewer jobs"):
        run_recognition_experiment(tmp_path, options=small_options, jobs=2)


def test_when_all_fail_the_error_tells_why(filled_cache, small_options):
    for person in range(1, 4):
        keep_session(filled_cache, small_options, person, 0, FAILED)
    with pytest.raises(RecognitionError, match="no face was found"):
        run_recognition_experiment(filled_cache, options=small_options)


def test_a_damaged_file_or_one_without_an_albedo_is_made_again(filled_cache, small_options, charts):
    path = session_file(filled_cache, small_options, 0, 0)
    path.write_bytes(path.read_bytes()[:1000])
    assert cached_session(filled_cache, small_options, 0, 0) is None
    with_minnaert = replace(small_options, brdfs=("oren-nayar", "minnaert"))
    assert session_file(filled_cache, with_minnaert, 0, 1) == session_file(filled_cache, small_options, 0, 1)
    assert cached_session(filled_cache, with_minnaert, 0, 1) is None
    kept = cached_session(filled_cache, small_options, 0, 1)
    assert set(kept.images) == set(charts[0, 1].images)


def test_other_scans_have_another_place(small_options):
    keys = {
        replace(small_options, **change).scans_key()
        for change in (
            {},
            {"size": 256},
            {"seed": 1},
            {"population": replace(small_options.population, individuality=0.5)},
        )
    }
    assert len(keys) == 4
    assert replace(small_options, persons=9, brdfs=("lambert",)).scans_key() == small_options.scans_key()


def test_intervals_and_comparison(filled_cache, small_options):
    report = run_recognition_experiment(filled_cache, options=small_options)
    for result in report.results:
        low, high = result.interval
        assert low <= result.rank_1 <= high
        assert high - low > 0.2
        by_persons = result.interval_by_persons
        assert by_persons[0] <= result.rank_1 <= by_persons[1]
    raw, albedo = report.results[0], report.result("albedo, oren-nayar")
    gained, lost, p = albedo.against(raw)
    assert gained - lost == round(8 * (albedo.rank_1 - raw.rank_1))
    assert 0 <= p <= 1
    assert raw.against(raw) == (0, 0, 1.0)
    assert albedo.separation > raw.separation
    figures = report.figures()
    assert figures["best"] == report.best.method
    assert [row["rank_1"] for row in figures["methods"]] == [result.rank_1 for result in report.results]


def test_an_unknown_method_is_refused(small_options, charts):
    with pytest.raises(ValueError, match="is not a method"):
        method_image("eigenfaces", charts[0, 0], small_options)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"persons": 1}, "persons is 1"),
        ({"probes": 0}, "probes 0"),
        ({"size": 2}, "size is 2"),
        ({"brdfs": ("phong",)}, "phong"),
        ({"brdfs": ()}, "one name or more"),
    ],
)
def test_options_out_of_range_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        RecognitionExperimentOptions(**wrong)


def test_jobs_below_one_are_refused(small_options, tmp_path):
    with pytest.raises(ValueError, match="jobs is 0"):
        run_recognition_experiment(tmp_path, options=small_options, jobs=0)


def test_a_scan_goes_through_the_whole_pipeline(small_options):
    made = made_session(small_options, 0, 0)
    assert not made.failure
    assert 0.5 < made.seen.mean() < 0.95
    texture, albedo = (made.images[name].astype(float) for name in ("texture", "oren-nayar"))
    assert (texture[~made.seen] == 0).all()
    assert (albedo[made.seen] > 0).all(axis=-1).mean() > 0.99
    # Less light is left in the albedo: its smooth variation over the face is smaller.
    lows = [np.log(np.maximum(image.max(-1), 1e-3))[made.seen].std() for image in (albedo, texture)]
    assert lows[0] < 0.8 * lows[1]


def test_ten_persons_are_recognised_by_their_albedo_and_hardly_by_their_texture(small_options, tmp_path):
    options = replace(small_options, persons=10, probes=1, brdfs=("oren-nayar",))
    report = run_recognition_experiment(tmp_path, options=options, jobs=2)
    raw, albedo = report.results[0], report.result("albedo, oren-nayar")
    assert report.converged
    assert not report.failures
    assert len(report.persons) == 10
    assert albedo.rank_1 >= 0.8
    assert albedo.rank_1 >= raw.rank_1 + 0.2
    assert len(report.trace) == 9
