import numpy as np
import polars as pl
import pytest

from cmedirl_jax.runs import intervals, paired, statistics
from experiments import verdicts
from experiments.measures import DIPS
from experiments.pooled import CellSeeds, Pooled

SEEDS = 160
EVERY = 250
MOST = 50 * EVERY


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    """Cells that differ do so clearly: no verdict hangs on the last digit of a p-value."""
    monkeypatch.setattr(paired, "FLIPS", 1_999)
    monkeypatch.setattr(intervals, "RESAMPLES", 500)


def cell(
    at=0,
    *,
    last=94.0,
    dips=0,
    expert=94.0,
    studies=(0,),
    episode_steps=100,
    spread=0.1,
    jump=None,
    diverged=0,
):
    """A cell whose seeds solve the task at step `at` and return about `last` from then on.

    Args:
        at: the step; None for never.
        last: return from then on.
        dips: how many seeds dip once.
        expert: return of the experts; None for a method without.
        studies: the study seeds.
        episode_steps: environment steps of an episode.
        spread: deviation of the last return over the seeds.
        diverged: how many seeds diverged.
        jump: added to the last return, by study seed.
    """
    pairs, rows, columns = [], [], []
    for study in studies:
        # Cells that differ in anything have other seeds.
        arguments = repr((at, last, dips, expert, spread))
        rng = np.random.default_rng([study, *arguments.encode()])
        for seed in range(SEEDS):
            steps = np.arange(51) * EVERY
            solved = np.zeros(51, bool) if at is None else steps >= at
            level = last + spread * rng.normal() + (jump or {}).get(study, 0.0)
            returns = np.where(solved, level, -1.0)
            if seed < dips:
                returns[-2] = 50.0
            pair = study * 2**32 + seed
            pairs.append(pair)
            curve = statistics.SeedCurve(steps, steps // episode_steps, returns)
            columns.append(statistics.seed_statistics(curve, 90.0))
            rows += [
                {"pair": pair, "protocol": "steps", "env_step": step, "episode": episode}
                | {"return_mean": value}
                for step, episode, value in zip(*map(np.ndarray.tolist, curve), strict=True)
            ]
    numbers = np.array(pairs)
    score = np.full(numbers.size, np.nan if expert is None else expert)
    return CellSeeds(
        pair=numbers,
        expert=np.full(numbers.size, -1) if expert is None else numbers,
        diverged=np.arange(numbers.size) % SEEDS < diverged,
        statistics=statistics.SeedStatistics(
            *(np.array(leaf, float) for leaf in zip(*columns, strict=True))
        ),
        expert_return=score,
        best_evaluation=score,
        best_return=score,
        evaluations=pl.DataFrame(rows),
    )


def judged(claim, *, by_episodes=False, **cells):
    """The verdict on a claim by one run of these cells, with 200 demonstrations unless said."""
    named = {}
    for name, one in cells.items():
        method, _, n_demos = name.partition("_n")
        method = method.replace("_", "-")
        number = int(n_demos or 0 if method == "ddpg" else n_demos or 200)
        named[method, number] = one
    run = Pooled(named, {"seeds": SEEDS}, MOST, 150 if by_episodes else None)
    (found,) = (one for one in verdicts.judge([run]) if one.name == claim)
    return found


@pytest.mark.parametrize(
    ("last", "verdict"),
    [
        (94.0, "supported"),
        (91.0, "supported"),
        (85.0, "not supported"),
    ],
)
def test_c1_all_methods_are_near_the_expert(last, verdict):
    cells = {name: cell(last=last) for name in ("ddpg", "hs_ddpg", "me_ddpg", "hs_me_ddpg")}
    assert judged("C1", **cells).verdict == verdict


def test_c1_is_supported_in_part_by_some_methods_and_needs_all_of_them():
    near, far = cell(), cell(last=80.0)
    cells = {"ddpg": far, "hs_ddpg": near, "me_ddpg": near, "hs_me_ddpg": near}
    assert judged("C1", **cells).verdict == "supported in part"
    assert judged("C1", hs_ddpg=near, me_ddpg=near).verdict == "inconclusive"


def test_c1_of_seeds_that_live_too_few_episodes_is_inconclusive():
    cells = {name: cell(episode_steps=999) for name in ("ddpg", "hs_ddpg", "me_ddpg", "hs_me_ddpg")}
    assert judged("C1", **cells).verdict == "inconclusive"


def test_c2_needs_to_be_faster_and_more_stable_than_every_other():
    slow = {name: cell(5_000, dips=80) for name in ("ddpg", "hs_ddpg", "me_ddpg")}
    assert judged("C2", hs_me_ddpg=cell(), **slow).verdict == "supported"
    assert judged("C2", hs_me_ddpg=cell(5_000, dips=80), **slow).verdict == "not supported"
    assert judged("C2", hs_me_ddpg=cell(5_000), **slow).verdict == "supported in part"
    assert judged("C2", hs_me_ddpg=cell(0, dips=72), **slow).verdict == "inconclusive"
    assert judged("C2", **slow).verdict == "not testable"


@pytest.mark.parametrize(
    ("hot", "verdict"),
    [
        (cell(0), "supported"),
        (cell(0, last=92.5), "supported"),
        (cell(0, last=96.0), "supported in part"),
        (cell(3_000, last=96.0), "not supported"),
        (cell(0, spread=30.0), "inconclusive"),
    ],
)
def test_c3_rises_fast_and_is_then_no_better(hot, verdict):
    assert judged("C3", hs_ddpg=hot, ddpg=cell(3_000, expert=None)).verdict == verdict


@pytest.mark.parametrize(
    ("at", "verdict"),
    [
        (12_000, "supported"),
        (9_000, "supported"),
        (7_750, "not supported"),
        (1_000, "not supported"),
        (None, "inconclusive"),
    ],
)
def test_c4_converges_after_about_120_episodes(at, verdict):
    assert judged("C4", ddpg=cell(at, expert=None)).verdict == verdict


def test_c4_of_seeds_that_never_converge_within_their_episodes_is_not_supported():
    never = cell(None, expert=None)
    assert judged("C4", by_episodes=True, ddpg=never).verdict == "not supported"


def test_c5_improves_and_saturates():
    def verdict(*at):
        cells = {f"hs_ddpg_n{n}": cell(one) for n, one in zip((1, 50, 200), at, strict=True)}
        return judged("C5", **cells).verdict

    assert verdict(6_000, 1_000, 1_000) == "supported"
    assert verdict(6_000, 3_000, 1_000) == "supported in part"
    assert verdict(1_000, 1_000, 1_000) == "not supported"
    assert judged("C5", hs_ddpg=cell()).verdict == "not testable"


@pytest.mark.parametrize(
    ("at", "verdict"), [(5_000, "supported"), (3_000, "not supported"), (9_000, "not supported")]
)
def test_c6_converge_after_about_50_episodes(at, verdict):
    assert judged("C6", me_ddpg=cell(at), hs_me_ddpg=cell(at)).verdict == verdict


@pytest.mark.parametrize(
    ("last", "spread", "verdict"),
    [
        (94.5, 0.1, "supported"),
        (94.0, 0.1, "not supported"),
        (90.5, 0.1, "not supported"),
        (94.5, 20.0, "inconclusive"),
    ],
)
def test_c7_exceed_the_expert(last, spread, verdict):
    one = cell(last=last, spread=spread)
    assert judged("C7", me_ddpg=one, hs_me_ddpg=one).verdict == verdict


@pytest.mark.parametrize(("claim", "other"), [("C8", "bc"), ("C9", "maxent_irl")])
def test_c8_and_c9_are_better_than_what_never_acts(claim, other):
    good, bad = cell(last=95.0), cell(last=91.0)
    assert judged(claim, me_ddpg=good, hs_me_ddpg=good, **{other: bad}).verdict == "supported"
    assert judged(claim, me_ddpg=bad, hs_me_ddpg=bad, **{other: good}).verdict == "not supported"
    assert judged(claim, me_ddpg=good, hs_me_ddpg=bad, **{other: cell(last=93.0)}).verdict == (
        "supported in part"
    )
    assert judged(claim, me_ddpg=good, hs_me_ddpg=good).verdict == "not testable"


def test_a_cell_that_diverged_proves_nothing():
    good, gone = cell(last=95.0), cell(None, diverged=120)
    claim = judged("C9", me_ddpg=good, hs_me_ddpg=good, maxent_irl=gone)
    assert claim.verdict == "inconclusive"
    assert "75% of a cell diverged" in claim.parts[0].measured
    few = cell(None, diverged=4)
    assert judged("C9", me_ddpg=good, hs_me_ddpg=good, maxent_irl=few).verdict == "supported"


def test_c10_is_not_testable():
    assert judged("C10", ddpg=cell()).verdict == "not testable"


def test_study_seeds_that_disagree_are_inconclusive_however_small_the_p_value():
    both = {0: 3.0, 1: -0.5}
    one = cell(studies=(0, 1), jump=both)
    claim = judged("C7", me_ddpg=one, hs_me_ddpg=one)
    assert claim.verdict == "inconclusive"
    assert "they disagree" in claim.parts[0].measured
    agreed = cell(studies=(0, 1), jump={0: 3.0, 1: 0.5})
    assert judged("C7", me_ddpg=agreed, hs_me_ddpg=agreed).verdict == "supported"


def test_p_values_are_corrected_for_all_tests_of_the_page():
    one = cell(last=94.03, spread=0.1)
    alone = judged("C7", me_ddpg=one, hs_me_ddpg=one)
    beside = judged(
        "C7", me_ddpg=one, hs_me_ddpg=one, bc=cell(spread=1.0), maxent_irl=cell(spread=1.0)
    )
    holm = [
        float(claim.parts[0].measured.split(" p ")[1].split(",")[0]) for claim in (alone, beside)
    ]
    assert holm[0] < holm[1]


def test_claims_about_episodes_are_read_off_runs_over_episodes():
    steps = Pooled({("ddpg", 0): cell(1_000, expert=None)}, {}, MOST, None)
    episodes = Pooled({("ddpg", 0): cell(12_000, expert=None)}, {}, MOST, 150)
    for runs in ([steps, episodes], [episodes, steps]):
        (found,) = (claim for claim in verdicts.judge(runs) if claim.name == "C4")
        assert found.verdict == "supported"


def test_cells_without_a_common_seed_are_not_compared():
    runs = Pooled(
        {("ddpg", 0): cell(studies=(0,)), ("hs-ddpg", 200): cell(studies=(1,))},
        {},
        MOST,
        None,
    )
    (found,) = (claim for claim in verdicts.judge([runs]) if claim.name == "C3")
    assert found.verdict == "not testable"


def test_methods_are_compared_at_a_number_of_demonstrations_that_both_have():
    good, bad = cell(last=95.0), cell(last=91.0)
    cells = {"me_ddpg_n200": bad, "me_ddpg_n50": good, "hs_me_ddpg_n50": good, "bc_n50": bad}
    claim = judged("C8", **cells)
    assert claim.verdict == "supported"
    assert all("(N_T 50) against bc (N_T 50)" in part.measured for part in claim.parts)


def test_of_runs_that_both_have_the_cells_the_one_with_more_seeds_is_read():
    few = Pooled({("ddpg", 0): cell(1_000)}, {}, MOST, None)
    many = Pooled({("ddpg", 0): cell(12_000, studies=(0, 1))}, {}, MOST, None)
    for runs in ([few, many], [many, few]):
        (found,) = (claim for claim in verdicts.judge(runs) if claim.name == "C4")
        assert found.verdict == "supported"


def test_where_all_seeds_live_as_many_episodes_speed_is_counted_in_episodes():
    cells = {"hs_ddpg": cell(0), "ddpg": cell(3_000, expert=None)}
    measured = judged("C3", by_episodes=True, **cells).parts[0].measured
    assert "convergence_episode: -30.0 [-30.0, -30.0]" in measured


def test_c1_of_seeds_without_known_experts_says_so():
    claim = judged("C1", ddpg=cell(expert=None))
    assert "no table says what its seeds' experts return" in claim.parts[0].measured


def test_a_seed_that_converged_at_its_last_evaluation_has_not_dipped():
    run = Pooled({}, {}, MOST, None)
    assert set(DIPS.of(cell(MOST), run)) == {0.0}
    assert set(DIPS.of(cell(None), run)) == {1.0}
