import dataclasses
import itertools
import signal
import threading
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from cmedirl_jax import training
from cmedirl_jax.agents import hot_start
from cmedirl_jax.agents.ddpg import DDPGHParams
from cmedirl_jax.agents.hot_start import HotStartHParams
from cmedirl_jax.io import checkpoint
from cmedirl_jax.networks import Architecture
from cmedirl_jax.runs.cells import cell as cell_lib
from cmedirl_jax.runs.cells import compiled as compiled_lib
from cmedirl_jax.runs.cells.cell import CellResult
from cmedirl_jax.runs.cells.record import Budget
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.errors import Interrupted
from cmedirl_jax.runs.storage.checkpoints import Checkpointer
from cmedirl_jax.training import Log
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.schedules import Schedule
from cmedirl_jax.training.settings import Settings
from tests.support import pools

SEEDS = 3
STARTS, STARTS_BY_EPISODES = 5, 7
LEARNING_STARTS = 20
LIMIT = 25
CHUNK = 25
"""Divides every budget below: calls of one length compile once."""
BY_STEPS = Budget(125, None, 50, STARTS)
BY_EPISODES = Budget(6 * LIMIT, 6, 50, STARTS, 2, STARTS_BY_EPISODES)


class Chunk(NamedTuple):
    """What one call of the training program did."""

    steps: np.ndarray
    log: Log
    actor: Any
    groups: int


class Report(NamedTuple):
    """A cell's progress, as it was when it was reported."""

    env_step: int
    solved_fraction: float
    evaluations: int


class Trained(NamedTuple):
    """A cell, and what it was made from."""

    result: CellResult
    chunks: list[Chunk]
    reports: list[Report]


def compile_linear(env, method="ddpg", subset_size=None):
    """Linear networks where episodes of 25 steps start near the goal, so that some reach it."""
    params = env.default_params.replace(
        max_episode_steps=LIMIT, start_low=0.35, start_high=0.44, power=0.004
    )
    spec = env.spec._replace(max_episode_steps=LIMIT)
    short = env._replace(spec=spec, default_params=params)
    settings = Settings(
        architecture=Architecture(hidden=(), output_scale=0.3),
        agent=DDPGHParams(actor_learning_rate=1.0, critic_learning_rate=0.1),
        schedule=Schedule(batch_size=4, learning_starts=LEARNING_STARTS),
        hot_start=HotStartHParams(steps=2),
    )
    devices = jax.devices()[:1]
    programs = compiled_lib.compiler(
        short, devices, capacity=BY_EPISODES.max_steps, subset_size=subset_size, group=2
    )
    return programs(METHODS[method], settings, SEEDS)


@pytest.fixture(scope="module")
def programs(env):
    return compile_linear(env)


def train(
    programs,
    budget,
    *,
    threshold=0.0,
    before_chunk=lambda state, first_step: state,
    checkpointer=None,
    n_demos=0,
    first_seed=0,
):
    pool = pools.for_learners(pools.scripted()) if n_demos else None
    chunks, reports, seed_keys = [], [], []

    def run(state, groups, data, steps, limit):
        keys = [key.tobytes() for key in np.asarray(jax.random.key_data(state.key))]
        if not seed_keys:
            seed_keys.extend(keys)
        # Seeds change their slots, never their keys.
        slots = [keys.index(key) for key in seed_keys]
        state = before_chunk(state, int(steps[0]))
        state, log = programs.run(state, groups, data, steps, limit)
        # Copies: the next call is given the state to overwrite.
        of_seeds = jax.tree.map(lambda leaf: np.array(leaf)[slots], (log, state.agent.actor))
        chunks.append(Chunk(np.array(steps), *of_seeds, groups))
        return state, log

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cell_lib, "CHUNK", CHUNK)
        result = cell_lib.train(
            programs._replace(run=run),
            jax.random.key(5),
            pool,
            n_demos,
            seeds_count=SEEDS,
            first_seed=first_seed,
            budget=budget,
            threshold=threshold,
            report=lambda found: reports.append(
                Report(found.env_step, found.solved_fraction, len(found.evaluations))
            ),
            checkpointer=checkpointer,
        )
    return Trained(result, chunks, reports)


@pytest.fixture(scope="module")
def by_steps(programs):
    return train(programs, BY_STEPS)


@pytest.fixture(scope="module")
def by_episodes(programs):
    return train(programs, BY_EPISODES)


class Row(NamedTuple):
    """One seed's evaluation."""

    seed: int
    env_step: int
    episode: int
    return_mean: float
    q_mean: float
    critic_loss: float


def evaluation_rows(result, protocol="steps", seed=None):
    return [
        Row(*row)
        for found in result.evaluations
        if found.protocol == protocol
        for row in zip(
            found.seed,
            found.env_step,
            found.episode,
            found.evaluation.return_mean,
            found.means.q_mean,
            found.means.critic_loss,
            strict=True,
        )
        if seed is None or row[0] == seed
    ]


def episode_rows(result, seed=None):
    """Every finished episode as `(seed, episode, env_step, return, length, terminated)`."""
    rows = zip(*result.episodes, strict=True)
    return sorted(row for row in rows if seed is None or row[0] == seed)


def whole_log(trained):
    """The log of all chunks, leaves `[seeds, steps]`."""
    logs = [chunk.log for chunk in trained.chunks]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *logs)


def actor_of(actors, seed):
    return jax.tree.map(lambda leaf: leaf[seed], actors)


def assert_same(one, another):
    jax.tree.map(np.testing.assert_array_equal, one, another)


def mean_return(programs, actor, starts):
    return np.asarray(programs.evaluator.on_starts(actor, starts).episode_return).mean(axis=1)


def test_every_seed_is_first_evaluated_at_step_0_before_any_update(by_steps):
    first = by_steps.result.evaluations[0]
    assert first.protocol == "steps"
    np.testing.assert_array_equal(first.seed, np.arange(SEEDS))
    np.testing.assert_array_equal(first.env_step, np.zeros(SEEDS))
    np.testing.assert_array_equal(first.episode, np.zeros(SEEDS))
    assert all(np.isnan(mean).all() for mean in first.means)


def test_evaluations_come_at_the_multiples_and_at_the_end(by_steps):
    for seed in range(SEEDS):
        steps = [row.env_step for row in evaluation_rows(by_steps.result, seed=seed)]
        assert steps == [0, 50, 100, 125]


def test_an_evaluation_is_of_the_policy_at_that_step(by_steps, programs):
    actors = {chunk.steps[-1] + 1: chunk.actor for chunk in by_steps.chunks}
    for found in by_steps.result.evaluations[1:]:
        expected = mean_return(programs, actors[found.env_step[0]], STARTS)[:SEEDS]
        np.testing.assert_allclose(found.evaluation.return_mean, expected, rtol=1e-6)


def test_q_mean_and_critic_loss_are_means_over_the_updates_since_the_last_evaluation(
    by_steps, by_episodes
):
    for run in (by_steps, by_episodes):
        log = whole_log(run)
        for seed in range(SEEDS):
            for before, row in itertools.pairwise(evaluation_rows(run.result, seed=seed)):
                updates = slice(max(before.env_step, LEARNING_STARTS), row.env_step)
                expected = log.q_mean[seed, updates].mean(), log.critic_loss[seed, updates].mean()
                np.testing.assert_allclose(row[-2:], expected, rtol=1e-5)


def test_episodes_are_those_of_the_log(by_steps):
    log = whole_log(by_steps)
    expected = []
    for seed in range(SEEDS):
        (ends,) = np.nonzero(log.done[seed])
        for number, end in enumerate(ends, start=1):
            columns = (log.episode_return, log.episode_length, log.terminated)
            expected.append((seed, number, end + 1, *(column[seed, end] for column in columns)))
    assert episode_rows(by_steps.result) == expected


@pytest.mark.parametrize("run", ["by_steps", "by_episodes"])
def test_episodes_follow_each_other_without_gaps(run, request):
    result = request.getfixturevalue(run).result
    ended_at_goal = set()
    for seed in range(SEEDS):
        _, number, env_step, returns, length, terminated = map(
            np.array, zip(*episode_rows(result, seed), strict=True)
        )
        np.testing.assert_array_equal(number, np.arange(number.size) + 1)
        np.testing.assert_array_equal(np.diff(env_step, prepend=0), length)
        assert ((length == LIMIT) | terminated & (length < LIMIT)).all()
        cost = 100.0 * terminated - returns
        assert ((cost >= -1e-4) & (cost <= 0.1 * length + 1e-4)).all()
        ended_at_goal |= set(terminated)
    assert ended_at_goal == {True, False}


def test_an_evaluation_counts_the_episodes_finished_by_then(by_steps):
    for row in evaluation_rows(by_steps.result):
        ends = [end for _, _, end, *_ in episode_rows(by_steps.result, row.seed)]
        assert row.episode == sum(end <= row.env_step for end in ends)


def test_a_cell_by_steps_ends_after_all_its_steps(by_steps):
    result = by_steps.result
    np.testing.assert_array_equal(result.env_steps, [BY_STEPS.max_steps] * SEEDS)
    np.testing.assert_array_equal(result.demonstration_steps, np.zeros(SEEDS))
    assert not result.diverged.any()
    assert result.reward is None
    for seed in range(SEEDS):
        assert_same(actor_of(result.final, seed), actor_of(by_steps.chunks[-1].actor, seed))


@pytest.mark.parametrize("run", ["by_steps", "by_episodes"])
def test_the_best_policy_returns_each_seeds_highest_evaluation(run, request, programs):
    result = request.getfixturevalue(run).result
    highest = [
        max(row.return_mean for row in evaluation_rows(result, seed=seed)) for seed in range(SEEDS)
    ]
    np.testing.assert_array_equal(mean_return(programs, result.best, STARTS), highest)


def test_reports_follow_steps_the_share_at_the_threshold_and_evaluations(programs, by_steps):
    returns = [found.evaluation.return_mean for found in by_steps.result.evaluations]
    threshold = float(np.median(returns))
    first, second, third, last = (np.mean(values >= threshold) for values in returns)
    solved = (first, first, second, second, third, last)
    expected = zip(range(0, 126, CHUNK), solved, (1, 1, 2, 2, 3, 4), strict=True)
    reports = train(programs, BY_STEPS, threshold=threshold).reports
    assert reports == [Report(*report) for report in expected]


def test_each_seed_ends_with_its_last_episode(by_episodes):
    result = by_episodes.result
    for seed, end in enumerate(result.env_steps):
        rows = episode_rows(result, seed)
        assert len(rows) == BY_EPISODES.max_episodes
        assert rows[-1][2] == end
        assert evaluation_rows(result, seed=seed)[-1][1:3] == (end, BY_EPISODES.max_episodes)
    assert len(set(result.env_steps)) > 1


def test_a_seed_that_has_ended_is_evaluated_once_more(by_episodes):
    result = by_episodes.result
    for seed, end in enumerate(result.env_steps):
        steps = [row.env_step for row in evaluation_rows(result, seed=seed)]
        assert steps == [*range(0, end, BY_EPISODES.evaluate_every), end]


def test_a_seed_that_has_ended_learns_no_more(by_episodes):
    result = by_episodes.result
    after_the_end = [
        (seed, chunk)
        for seed, end in enumerate(result.env_steps)
        for chunk in by_episodes.chunks
        if chunk.steps[-1] + 1 >= end
    ]
    assert len(after_the_end) > SEEDS
    for seed, chunk in after_the_end:
        assert_same(actor_of(chunk.actor, seed), actor_of(result.final, seed))


def test_groups_without_a_running_seed_are_not_stepped(programs, by_steps, by_episodes):
    assert {chunk.groups for chunk in by_steps.chunks} == {2}
    # Every chunk ends with an evaluation, so no seed is kept for one after its end.
    trained = train(programs, dataclasses.replace(BY_EPISODES, evaluate_every=CHUNK))
    np.testing.assert_array_equal(trained.result.env_steps, by_episodes.result.env_steps)
    running = [
        sum(chunk.steps[0] < end for end in trained.result.env_steps) for chunk in trained.chunks
    ]
    assert min(running) < SEEDS
    assert [chunk.groups for chunk in trained.chunks] == [-(-count // 2) for count in running]
    assert episode_rows(trained.result) == episode_rows(by_episodes.result)
    assert_same(trained.result.final, by_episodes.result.final)
    # Neither fewer groups nor seeds in other slots compile again.
    assert programs.run._cache_size() <= 2, "with a limit of episodes and without"


def test_an_ended_seeds_last_evaluation_is_of_its_final_policy(by_episodes, programs):
    last = [evaluation_rows(by_episodes.result, seed=seed)[-1].return_mean for seed in range(SEEDS)]
    final = mean_return(programs, by_episodes.result.final, STARTS)
    np.testing.assert_allclose(final, last, rtol=1e-6)


def test_a_cell_ends_by_steps_or_by_episodes_whichever_comes_first(programs, by_episodes):
    fourth = [int(episode_rows(by_episodes.result, seed)[3][2]) for seed in range(SEEDS)]
    steps = (min(fourth) + max(fourth)) // 2
    assert min(fourth) < steps < max(fourth)
    budget = dataclasses.replace(BY_EPISODES, max_steps=steps, max_episodes=4)
    result = train(programs, budget).result
    np.testing.assert_array_equal(result.env_steps, np.minimum(fourth, steps))


def test_evaluations_by_episodes_come_with_the_chunk_that_passes_another_multiple(
    by_episodes, programs
):
    expected = []
    passed = dict.fromkeys(range(SEEDS), 0)
    for chunk in by_episodes.chunks:
        step = chunk.steps[-1] + 1
        returns = mean_return(programs, chunk.actor, STARTS_BY_EPISODES)
        for seed, before in passed.items():
            number = sum(row[2] <= step for row in episode_rows(by_episodes.result, seed))
            if number // 2 > before:
                passed[seed] = number // 2
                end = min(step, by_episodes.result.env_steps[seed])
                expected.append((seed, end, number, returns[seed]))
    found = [row[:4] for row in evaluation_rows(by_episodes.result, "episodes")]
    assert [row[:3] for row in found] == [row[:3] for row in expected]
    np.testing.assert_allclose([row[3] for row in found], [row[3] for row in expected], rtol=1e-6)


def diverge_at(step, *which):
    """Give the seeds `which` an infinite learning rate from `step` on."""

    def before_chunk(state, first_step):
        if first_step != step:
            return state
        hparams = state.agent.hparams
        rate = hparams.actor_learning_rate.at[np.array(which)].set(np.inf)
        return state.replace(
            agent=state.agent.replace(hparams=hparams.replace(actor_learning_rate=rate))
        )

    return before_chunk


def test_a_diverged_seed_is_marked_and_the_others_do_not_notice(programs, by_steps):
    result = train(programs, BY_STEPS, before_chunk=diverge_at(50, 1)).result
    np.testing.assert_array_equal(result.diverged, [False, True, False])
    np.testing.assert_array_equal(result.env_steps, [125, 50, 125])
    for seed in (0, 2):
        np.testing.assert_array_equal(
            evaluation_rows(result, seed=seed), evaluation_rows(by_steps.result, seed=seed)
        )
        assert episode_rows(result, seed) == episode_rows(by_steps.result, seed)
        assert_same(actor_of(result.best, seed), actor_of(by_steps.result.best, seed))


def test_a_diverged_seed_keeps_what_came_before_the_chunk_and_its_best_policy(programs, by_steps):
    result = train(programs, BY_STEPS, before_chunk=diverge_at(50, 1)).result
    np.testing.assert_array_equal(
        evaluation_rows(result, seed=1), evaluation_rows(by_steps.result, seed=1)[:2]
    )
    before = [row for row in episode_rows(by_steps.result, 1) if row[2] <= 50]
    assert episode_rows(result, 1) == before
    highest = max(row.return_mean for row in evaluation_rows(result, seed=1))
    # Evaluated again beside other seeds, it may round otherwise.
    again = mean_return(programs, result.best, STARTS)[1]
    np.testing.assert_allclose(again, highest, rtol=1e-6)


def test_a_cell_ends_when_every_seed_has_diverged(programs):
    trained = train(programs, BY_STEPS, before_chunk=diverge_at(0, *range(SEEDS)))
    assert trained.result.diverged.all()
    assert [report.env_step for report in trained.reports] == [0, 25]
    assert len(trained.result.evaluations) == 1


def assert_whole(line):
    assert "goes on from its checkpoint at step" in line


def checkpointer(folder, *, stop_after=None):
    """Saves every chunk; a signal comes during the chunk that follows `stop_after` others."""
    interruption = Interruption()
    checkpointer = Checkpointer(folder, {}, every=0.0, interruption=interruption, say=assert_whole)
    save_if_due, visits = checkpointer.save_if_due, itertools.count()

    def visit_and_count(step, take):
        if next(visits) == stop_after:
            interruption.signal = signal.SIGTERM
        save_if_due(step, take)

    checkpointer.save_if_due = visit_and_count
    return checkpointer


def test_training_goes_on_while_its_past_is_saved(programs, by_episodes, tmp_path, monkeypatch):
    """A checkpoint is of its step, however far training has come when it is written."""
    trained = threading.Event()
    save = checkpoint.save

    def save_late(*arguments):
        assert trained.wait(60)
        save(*arguments)

    monkeypatch.setattr(checkpoint, "save", save_late)
    keeping = checkpointer(tmp_path)
    save_if_due, visits = keeping.save_if_due, itertools.count()

    def visit_once(step, take):
        # A seed ends in each of the chunks that follow.
        if next(visits) == 2:
            save_if_due(step, take)

    keeping.save_if_due = visit_once
    assert_same_results(
        train(programs, BY_EPISODES, checkpointer=keeping).result, by_episodes.result
    )
    trained.set()
    keeping.wait()
    rest = train(programs, BY_EPISODES, checkpointer=checkpointer(tmp_path))
    assert rest.chunks[0].steps[0] == 3 * CHUNK
    assert_same_results(rest.result, by_episodes.result)


def assert_same_results(actual, expected):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(x, y)
        assert np.asarray(x).dtype == np.asarray(y).dtype


@pytest.mark.parametrize("chunks", [1, 2, 4])
@pytest.mark.parametrize("budget", [BY_STEPS, BY_EPISODES], ids=["steps", "episodes"])
def test_a_cell_that_was_stopped_goes_on_to_the_same_result(
    programs, by_steps, by_episodes, tmp_path, budget, chunks
):
    whole = by_steps if budget is BY_STEPS else by_episodes
    with pytest.raises(Interrupted, match="SIGTERM"):
        train(programs, budget, checkpointer=checkpointer(tmp_path, stop_after=chunks - 1))
    rest = train(programs, budget, checkpointer=checkpointer(tmp_path))
    assert_same_results(rest.result, whole.result)
    assert rest.reports == whole.reports[chunks:]
    assert [list(chunk.steps) for chunk in rest.chunks] == [
        list(chunk.steps) for chunk in whole.chunks[chunks:]
    ]


def test_a_cell_that_was_stopped_after_its_last_chunk_takes_no_more_steps(
    programs, by_steps, tmp_path
):
    last = len(by_steps.chunks) - 1
    with pytest.raises(Interrupted):
        train(programs, BY_STEPS, checkpointer=checkpointer(tmp_path, stop_after=last))
    rest = train(programs, BY_STEPS, checkpointer=checkpointer(tmp_path))
    assert_same_results(rest.result, by_steps.result)
    assert not rest.chunks


def test_a_cell_goes_on_with_a_seed_that_has_diverged(programs, tmp_path):
    diverge = diverge_at(25, 1)
    whole = train(programs, BY_STEPS, before_chunk=diverge)
    keeping = checkpointer(tmp_path, stop_after=2)
    with pytest.raises(Interrupted):
        train(programs, BY_STEPS, before_chunk=diverge, checkpointer=keeping)
    rest = train(programs, BY_STEPS, checkpointer=checkpointer(tmp_path))
    assert_same_results(rest.result, whole.result)


def test_a_cell_goes_on_in_other_slots(programs, by_episodes, tmp_path):
    with pytest.raises(Interrupted):
        train(programs, BY_EPISODES, checkpointer=checkpointer(tmp_path, stop_after=3))
    wider = programs._replace(slots=programs.slots + 2)
    rest = train(wider, BY_EPISODES, checkpointer=checkpointer(tmp_path)).result
    np.testing.assert_array_equal(rest.env_steps, by_episodes.result.env_steps)
    for actual, expected in zip(
        jax.tree.leaves(rest.final), jax.tree.leaves(by_episodes.result.final), strict=True
    ):
        np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-5)


def test_a_cell_goes_on_where_a_command_asks_for_more_demonstrations_elsewhere(
    env, programs, tmp_path
):
    """Their largest number pads the subset of every seed; the padding is not saved."""
    # What does not depend on it is not compiled again.
    shared = {"draw_networks": programs.draw_networks, "evaluator": programs.evaluator}
    narrow, wide = (compile_linear(env, "hs-ddpg", size)._replace(**shared) for size in (2, 7))
    budget = dataclasses.replace(BY_STEPS, max_steps=75)
    whole = train(narrow, budget, n_demos=2)
    for before, after in ((narrow, wide), (wide, narrow)):
        folder = tmp_path / ("narrow" if before is narrow else "wide")
        with pytest.raises(Interrupted):
            train(before, budget, n_demos=2, checkpointer=checkpointer(folder, stop_after=1))
        rest = train(after, budget, n_demos=2, checkpointer=checkpointer(folder))
        assert len(rest.chunks) == 1
        assert_same_results(rest.result, whole.result)


def test_a_later_block_has_the_seeds_of_its_numbers(programs, by_steps):
    """Seeds 2 to 4, of which the first was the last of seeds 0 to 2."""
    later = train(programs, BY_STEPS, first_seed=2).result
    assert episode_rows(later, 0) == [(0, *row[1:]) for row in episode_rows(by_steps.result, 2)]
    assert_same(actor_of(later.final, 0), actor_of(by_steps.result.final, 2))


def test_going_on_does_not_compile_again(programs, tmp_path):
    before = programs.run._cache_size()
    with pytest.raises(Interrupted):
        train(programs, BY_STEPS, checkpointer=checkpointer(tmp_path, stop_after=0))
    train(programs, BY_STEPS, checkpointer=checkpointer(tmp_path))
    assert programs.run._cache_size() == before


@pytest.mark.parametrize("name", METHODS)
def test_every_methods_state_can_be_saved(env, name):
    """Orbax refuses empty arrays."""
    method = METHODS[name]
    if method.tabular and not method.interacts:
        return
    trainer = training.make(env, method, Settings(), capacity=100, subset_size=2)
    data = hot_start.data(pools.scripted(2)) if method.uses_demonstrations else None
    state = jax.eval_shape(lambda: trainer.init(jax.random.key(0), data, 2))
    assert all(leaf.size for leaf in jax.tree.leaves(state))
