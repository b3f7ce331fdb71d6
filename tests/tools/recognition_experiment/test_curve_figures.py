"""Figures of several methods: bars apart, equal curves drawn once."""

import numpy as np
import pytest
from recognition_experiment.curve_figures import cmc_figure, roc_figure

from scan2albedo.recognition import cmc_curve, identify_by_similarity, roc_curve


def build_identification(seed=0, persons=20, each=2, separation=1.5, decimals=9):
    """Normal similarities, higher by `separation` for the right person; rounded to make ties."""
    names = [f"p{k:03d}" for k in range(persons)]
    probes = names * each
    scores = np.random.default_rng(seed).standard_normal((len(probes), persons))
    scores += separation * (np.array(probes)[:, None] == np.array(names))
    return identify_by_similarity(scores.round(decimals), names, probes)


def test_figures_show_every_curve_with_its_interval():
    found = {"albedo": build_identification(separation=3.0), "texture": build_identification()}
    curves = {name: cmc_curve(one) for name, one in found.items()}
    axis = cmc_figure(curves).axes[0]
    assert [len(line.get_xdata()) for line in axis.lines] == [20, 20]
    assert len(axis.collections) == 2
    assert axis.figure.legends[0].get_texts()[1].get_text().startswith("texture, 40 probes: rank 1")
    rocs = {name: roc_curve(one, resamples=20) for name, one in found.items()}
    axis = roc_figure(rocs).axes[0]
    assert axis.get_xscale() == "log"
    texture = rocs["texture"]
    np.testing.assert_array_equal(axis.lines[1].get_ydata(), texture.true_accept_rate[texture.supported])
    assert axis.lines[1].get_xdata().min() >= 1 / texture.impostors
    with pytest.raises(ValueError, match="no curve"):
        cmc_figure({})
    with pytest.raises(ValueError, match=r"confidences \[0\.9, 0\.95\]"):
        cmc_figure(curves | {"other": cmc_curve(found["albedo"], confidence=0.9)})


def test_figures_of_many_methods_have_bars_apart_and_name_the_claims():
    found = {str(k): build_identification(k, persons=8, each=2) for k in range(5)}
    cmc = cmc_figure({name: cmc_curve(one) for name, one in found.items()}).axes[0]
    roc = roc_figure({name: roc_curve(one, resamples=5) for name, one in found.items()}).axes[0]
    for axis in (cmc, roc):
        places = [{segment[0, 0] for segment in lines.get_segments()} for lines in axis.collections]
        assert len(places) == 5
        assert all(places)
        assert len(set.union(*places)) == sum(len(one) for one in places)
    legends = [axis.figure.legends[0].get_texts()[0].get_text() for axis in (cmc, roc)]
    assert legends[0].startswith("0, 16 probes: rank 1 ")
    assert legends[1].startswith("0, 16 genuine claims: equal error ")


def test_equal_curves_are_drawn_once_with_all_their_names():
    perfect, worse = build_identification(separation=99.0), build_identification()
    found = {"albedo": perfect, "texture": worse, "shape": perfect, "shape and albedo": perfect}
    cmc = cmc_figure({name: cmc_curve(one) for name, one in found.items()}).axes[0]
    roc = roc_figure({name: roc_curve(one, resamples=20) for name, one in found.items()}).axes[0]
    for axis in (cmc, roc):
        assert len(axis.lines) == len(axis.collections) == 2
        first, second = (text.get_text() for text in axis.figure.legends[0].get_texts())
        assert first.startswith("albedo; shape; shape and albedo, one curve for all, 40 ")
        assert second.startswith("texture, 40 ")
        assert axis.lines[0].get_linewidth() > axis.lines[1].get_linewidth()
