import pytest

from benchmarks import soak
from benchmarks.soak import Options, Sample

MEBIBYTE = 2**20


def samples(sizes):
    """Three looks at each cell, which needs another ten MiB for a while."""
    return [
        Sample(float(cell), cell, (size + extra) * MEBIBYTE, 9, 20)
        for cell, size in enumerate(sizes)
        for extra in (10, 0, 10)
    ]


def test_growth_is_of_what_stays_after_the_first_quarter():
    assert soak.growth_per_cell(samples([1, 400, 500, 500, 500, 500])) == pytest.approx(0, abs=1)
    grows = samples([1, 100, *range(500, 520, 2)])
    assert soak.growth_per_cell(grows) == pytest.approx(2 * MEBIBYTE, rel=0.01)


@pytest.mark.slow
def test_two_thousand_seeds_leave_nothing_behind(tmp_path):
    code, seen = soak.watch(Options(), tmp_path / "run")
    assert code == 0
    assert seen[-1].cells == 20
    fifth, *_, last = soak.least_per_cell(seen)[5:]
    assert soak.growth_per_cell(seen) * 15 < 0.05 * fifth.resident_bytes
    assert last.open_files <= fifth.open_files
    assert last.threads <= fifth.threads + 2
