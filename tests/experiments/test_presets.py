import dataclasses
from pathlib import Path

import pytest

from cmedirl_jax import envs
from cmedirl_jax.irl import IRLHParams
from cmedirl_jax.irl.reward_batches import RewardBatchSettings
from cmedirl_jax.irl.rewards import RewardNetworkSettings
from cmedirl_jax.runs import validation
from cmedirl_jax.training import compose
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.schedules import RewardSchedule
from cmedirl_jax.training.settings import Settings
from experiments.presets import PRESETS
from experiments.run_grid import parse


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("method", METHODS)
def test_every_preset_builds_every_method(name, method, spec):
    built = compose.compose(spec, METHODS[method], PRESETS[name].settings, capacity=10)
    assert (built.learner is not None) == (METHODS[method].reward is not None)


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_knows_its_name_and_its_folder(name):
    assert PRESETS[name].preset == name
    assert PRESETS[name].folder == Path("results") / name


def test_the_default_study_is_the_tuned_one_of_the_design():
    config = parse([])
    assert config == PRESETS["tuned"]
    assert config.methods == ("ddpg", "hs-ddpg", "me-ddpg", "hs-me-ddpg")
    assert (config.n_demos, config.seeds, config.max_steps, config.max_episodes) == (
        (200,),
        100,
        12_000,
        None,
    )
    assert (config.evaluate_every, config.evaluation_starts) == (250, 10)


def test_paper_is_the_papers_letter():
    config = PRESETS["paper"]
    settings = config.settings
    agent, exploration = settings.agent, settings.exploration
    assert agent.actor_learning_rate == agent.critic_learning_rate == 1e-5
    assert settings.reward.learning_rate == 1e-5
    assert settings.schedule.batch_size == settings.reward_batches.batch_size == 32
    assert settings.schedule.recent == 10_000
    assert settings.schedule.replay_capacity is settings.reward_batches.recent is None
    assert (settings.schedule.target_period, agent.tau) == (300, 1.0)
    assert agent.bootstrap_at_termination
    assert agent.pre_activation_penalty == 0.0
    assert exploration.kind == "epsilon-greedy"
    epsilon = exploration.epsilon_greedy
    assert (epsilon.epsilon_start, epsilon.epsilon_end, epsilon.epsilon_steps) == (1.0, 0.01, 5_000)
    assert epsilon.hold == 1.0
    assert settings.reward_schedule.storage == "store"
    assert settings.reward_batches.recent is None
    assert settings.reward_schedule.stop is None
    assert settings.reward_schedule.period == 1
    assert settings.reward.bounded_by == "none"
    assert settings.hot_start.critic == "softmax"
    assert settings.schedule.cloning == "none"
    assert config.seeds == 100
    assert (config.evaluate_every_episodes, config.evaluation_starts_episodes) == (100, 100)
    assert config.max_steps is None
    assert config.evaluate_every == 1_000


def test_a_budget_of_episodes_alone_leaves_room_for_the_longest():
    config = PRESETS["paper"]
    budget = validation.budget_of(config, envs.make(config.env))
    assert (budget.max_episodes, budget.max_steps) == (150, 150 * 999)


@pytest.mark.parametrize(("max_steps", "expected"), [(1_000, 1_000), (10_000, 1_998)])
def test_a_budget_of_both_takes_the_smaller(max_steps, expected):
    config = dataclasses.replace(PRESETS["tuned"], max_steps=max_steps, max_episodes=2)
    assert validation.budget_of(config, envs.make(config.env)).max_steps == expected


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_what_the_command_line_makes_of_its_name(name):
    assert parse(["--preset", name]) == PRESETS[name]


def test_options_override_the_preset_before_and_after_its_name():
    expected = dataclasses.replace(PRESETS["paper"], seeds=3, n_demos=(1, 10))
    options = ["--seeds", "3", "--n-demos", "1", "10"]
    assert parse(["--preset", "paper", *options]) == expected
    assert parse([*options, "--preset=paper"]) == expected


def test_dotted_options_reach_the_nested_settings_and_leave_the_rest_to_the_preset():
    options = {
        "--agent.tau": "0.5",
        "--reward.bound": "0.2",
        "--experts.steps": "70",
        "--reward-schedule.stop": "None",
        "--exploration.epsilon-greedy.hold": "4",
        "--hot-start.critic": "large-margin",
        "--hot-start.margin": "0.5",
        "--schedule.frozen-actor-steps": "60",
        "--schedule.cloning": "constant",
        "--exploration.hot-start-factor": "0.25",
    }
    words = (word for option in options.items() for word in option)
    config = parse(["--preset", "smoke", *words, "--agent.q-filter"])
    before = PRESETS["smoke"]
    settings = before.settings
    assert config.settings == dataclasses.replace(
        settings,
        agent=settings.agent.replace(tau=0.5, q_filter=True),
        reward=settings.reward.replace(bound=0.2),
        reward_schedule=dataclasses.replace(settings.reward_schedule, stop=None),
        exploration=dataclasses.replace(
            settings.exploration,
            hot_start_factor=0.25,
            epsilon_greedy=settings.exploration.epsilon_greedy.replace(hold=4.0),
        ),
        hot_start=settings.hot_start.replace(critic="large-margin", margin=0.5),
        schedule=dataclasses.replace(settings.schedule, frozen_actor_steps=60, cloning="constant"),
    )
    assert config.experts == dataclasses.replace(before.experts, steps=70)
    assert dataclasses.replace(config, settings=settings, experts=before.experts) == before


@pytest.mark.parametrize("arguments", [["--preset", "none"], ["--tau", "0.5"], ["--seeds", "many"]])
def test_what_tyro_finds_keeps_its_form(arguments, capsys):
    with pytest.raises(SystemExit) as error:
        parse(arguments)
    assert error.value.code == 2
    assert arguments[0] in capsys.readouterr().err


def test_the_librarys_defaults_are_the_tuned_preset():
    """What the learning tests train is what the command trains."""
    assert PRESETS["tuned"].settings == Settings()


def test_everything_about_the_learned_reward_has_a_dotted_name():
    config = parse(
        [
            *("--methods", "me-ddpg", "gail"),
            *("--reward.objective", "transition", "--reward.gradient-penalty", "0.5"),
            *("--reward.bounded-by", "clip", "--reward.gauge", "zero-mean"),
            *("--reward.absorbing", "--reward.weight-limit", "4"),
            *("--reward-batches.weights", "fusion", "--reward-schedule.shaping", "alone"),
            *("--reward-network.kind", "fourier", "--reward-network.inputs", "state"),
            *("--gail.form", "logit D", "--exploration.epsilon-greedy.noise", "0.2"),
        ]
    )
    settings = config.settings
    assert settings.reward == IRLHParams(
        objective="transition",
        gradient_penalty=0.5,
        bounded_by="clip",
        gauge="zero-mean",
        absorbing=True,
        weight_limit=4.0,
    )
    assert settings.reward_batches == RewardBatchSettings(weights="fusion")
    assert settings.reward_schedule == RewardSchedule(shaping="alone")
    network = RewardNetworkSettings(kind="fourier", inputs="state")
    assert settings.reward_network == network
    assert settings.gail.form == "logit D"
    assert settings.exploration.epsilon_greedy.noise == 0.2
    validation.check(config)


def test_the_full_grid_is_the_papers_sweep_under_either_preset():
    tuned, paper = parse(["--grid", "full"]), parse(["--grid", "full", "--preset", "paper"])
    assert tuned.n_demos == paper.n_demos == (1, 5, 10, 50, 100, 200)
    assert (tuned.max_steps, paper.max_steps) == (20_000, None)
    assert tuned == dataclasses.replace(
        PRESETS["tuned"], grid="full", n_demos=tuned.n_demos, max_steps=20_000
    )
    assert tuned.folder == Path("results/tuned-full")
    assert parse(["--grid", "full", "--n-demos", "7"]).n_demos == (7,)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], ("each", 100, 14_000, 200)),
        (["--seeds", "7", "--n-demos", "300"], ("each", 7, 14_000, 300)),
        (["--expert", "best"], ("best", 16, 14_000, 1_024)),
        (["--expert", "all", "--experts.seeds", "3"], ("all", 3, 14_000, 1_024)),
    ],
)
def test_experts_are_as_many_as_their_learners_need(arguments, expected):
    assert parse(arguments).resolved_experts[:4] == expected
