"""Every bench can be loaded, and those that have bars for quick runs keep them."""

import pytest
from bench.command import main
from bench.registry import bars, benches_of, described


@pytest.mark.parametrize("name", described())
def test_a_bench_names_methods_that_it_has(name):
    for bench in benches_of(name).values():
        assert {*bench.slow, *bench.quick} <= {*bench.methods, *bench.peers}


def test_bars_are_of_benches_and_methods_that_exist():
    for bar in bars():
        assert bar.method in benches_of(bar.bench)[bar.bench].chosen([], bar.quick), bar


@pytest.mark.slow
@pytest.mark.parametrize("name", dict.fromkeys(bar.bench for bar in bars() if bar.quick))
def test_quick_runs_keep_their_bars(name, capsys):
    status = main([name, "--quick", "--check"])
    printed = capsys.readouterr().out
    if "no data: " in printed:
        pytest.skip("its data are not beside the repository")
    assert status == 0, printed
