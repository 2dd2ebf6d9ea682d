import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import checks, envs, irl, networks, ranges, tabular
from cmedirl_jax.agents import ddpg, exploration, hot_start
from cmedirl_jax.agents.exploration import EpsilonGreedyHParams
from cmedirl_jax.data import demonstrations, episodes, replay
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.irl import rewards, shaping
from cmedirl_jax.training import compose, schedules
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import RewardBatch, Transition
from tests.support import pools


def transition(spec, *leading):
    vector = jnp.zeros((*leading, spec.observation_dim))
    scalar = jnp.zeros(leading)
    return Transition(
        vector, jnp.zeros((*leading, spec.action_dim)), scalar, vector, scalar.astype(bool)
    )


@pytest.mark.parametrize("leading", [(), (4,), (3, 5)])
def test_transitions_of_the_specs_sizes_pass(skewed_spec, leading):
    checks.transition_shapes(skewed_spec, transition(skewed_spec, *leading), leading, "batch")


@pytest.mark.parametrize("field", Transition._fields)
def test_any_leaf_of_another_shape_is_refused_with_both_shapes(skewed_spec, field):
    wrong = transition(skewed_spec, 4)._replace(**{field: jnp.zeros((4, 7))})
    with pytest.raises(ValueError, match=rf"batch: expected .*got .*'{field}': \(4, 7\)"):
        checks.transition_shapes(skewed_spec, wrong, (4,), "batch")


def test_other_leading_axes_are_refused(skewed_spec):
    with pytest.raises(ValueError, match="batch: expected"):
        checks.transition_shapes(skewed_spec, transition(skewed_spec, 4), (5,), "batch")


@pytest.mark.parametrize("field", Transition._fields)
def test_any_leaf_of_another_dtype_is_refused_by_name(skewed_spec, field):
    given = transition(skewed_spec, 4)
    wrong = given._replace(**{field: getattr(given, field).astype(int)})
    with pytest.raises(TypeError, match=rf"batch: {field}: expected .*, got int32"):
        checks.transition_shapes(skewed_spec, wrong, (4,), "batch")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"observation_dim": 0}, "observation_dim must be at least 1, got 0"),
        ({"action_dim": -1}, "action_dim must be at least 1, got -1"),
        ({"max_episode_steps": 0}, "max_episode_steps must be at least 1, got 0"),
        ({"observation_dim": 2}, r"observation_low: expected shape \(2,\), got \(3,\)"),
        ({"action_high": np.array(1.0)}, r"action_high: expected shape \(2,\), got \(\)"),
        ({"action_low": np.array([-np.inf, 0.5])}, "action bounds must be finite"),
        ({"action_high": np.array([3.0, 1e39])}, "action bounds must be finite"),
        ({"action_high": np.array([3.0, np.nan])}, "action bounds must be finite"),
        ({"action_low": np.array([-1.0, 1.0])}, "action_low must be below action_high"),
        ({"observation_low": np.array([-1.0, 0.0, 11.0])}, "observation_low must be below"),
        ({"observation_high": np.array([3.0, np.nan, 10.0])}, "observation_low must be below"),
    ],
)
def test_a_specification_that_contradicts_itself_is_refused(skewed_spec, change, named):
    checks.env_spec(skewed_spec)
    wrong = skewed_spec._replace(**change)
    for refuse in (checks.env_spec, ddpg.make, irl.make, irl.gail.make):
        with pytest.raises(ValueError, match=rf"^Skewed-v0: .*{named}"):
            refuse(wrong)
    with pytest.raises(ValueError, match=named):
        compose.compose(wrong, METHODS["ddpg"], Settings(), capacity=10)


def takers_of_a_spec():
    """Every public function that reads a specification, by name."""
    env = envs.make("MountainCarContinuous-v0")
    pool = pools.random_pool([3])
    return {
        "envs.check": lambda spec: envs.check(env._replace(spec=spec)),
        "compose": lambda spec: compose.compose(spec, METHODS["ddpg"], Settings(), capacity=10),
        "ddpg.make": ddpg.make,
        "irl.make": irl.make,
        "gail.make": irl.gail.make,
        "random": irl.controls.random,
        "replay.make": lambda spec: replay.make(spec, 10),
        "networks.make": networks.make,
        "exploration.make": exploration.make,
        "rewards.make": rewards.make,
        "radial_basis": lambda spec: rewards.radial_basis(spec, 2),
        "fourier": lambda spec: rewards.fourier(spec, 1),
        "grids": lambda spec: tabular.discretise.grids(spec, (2, 2), (2,)),
        "validate": lambda spec: demonstrations.validate(pool, spec),
    }


@pytest.mark.parametrize(
    ("bound", "named"),
    [
        ([-1.0], "a numpy array of float32, got a list"),
        ((-1,), "a numpy array of float32, got a tuple"),
        (jnp.array([-1.0]), "a numpy array of float32, got a ArrayImpl"),
        (np.array([-1]), "float32, got int64"),
        (np.array([-1.0], np.float16), "float32, got float16"),
    ],
)
def test_all_that_take_a_specification_refuse_the_same_bounds(spec, bound, named):
    for refuse in takers_of_a_spec().values():
        with pytest.raises(TypeError, match=rf"^{spec.id}: action_low: expected {named}$"):
            refuse(spec._replace(action_low=bound))


def test_bounds_in_float64_are_float32_to_all_or_with_x64_refused_by_all(spec):
    wide = spec._replace(action_low=np.array([-1.0]), observation_high=np.array([0.6, 0.07]))
    for accept in takers_of_a_spec().values():
        accept(wide)
    seen = networks.make(wide).squash(jnp.float32([0.3]))
    np.testing.assert_array_equal(seen, networks.make(spec).squash(jnp.float32([0.3])))
    with jax.enable_x64(True):
        for refuse in takers_of_a_spec().values():
            with pytest.raises(TypeError, match="expected float32, got float64"):
                refuse(wide)


@pytest.mark.parametrize("discount", [2.0, float("nan"), -0.5, np.array(2.0), jnp.array(2.0)])
def test_hyperparameters_out_of_range_are_refused_by_all_that_take_them(spec, discount):
    with pytest.raises(ValueError, match=f"discount must be between 0 and 1, got {discount}"):
        ddpg.make(spec, ddpg.DDPGHParams(discount=discount))
    zero = jnp.zeros(3)
    with pytest.raises(ValueError, match=f"discount must be between 0 and 1, got {discount}"):
        shaping.potential(zero, zero, zero, zero > 0, discount)
    for make in (irl.make, irl.controls.random):
        with pytest.raises(ValueError, match=r"bound must be .*, got -0.5"):
            make(spec, irl.IRLHParams(bound=-0.5))
    with pytest.raises(ValueError, match=r"learning_rate must be .*, got nan"):
        irl.gail.make(spec, irl.gail.GAILHParams(learning_rate=float("nan")))
    with pytest.raises(ValueError, match=r"epsilon_start must be between 0 and 1, got 2\.0"):
        exploration.epsilon_greedy(spec, EpsilonGreedyHParams(epsilon_start=2.0))
    with pytest.raises(ValueError, match="weight must be finite, got inf"):
        shaping.additive(zero, zero, float("inf"))


def test_observations_may_be_unbounded(skewed_spec):
    infinite = np.full(3, np.inf)
    checks.env_spec(skewed_spec._replace(observation_low=-infinite, observation_high=infinite))


STATES, ACTIONS, HORIZON, SUCCESSORS = 4, 3, 5, 2


def abstract(function):
    return lambda **arrays: jax.eval_shape(lambda: function(**arrays))


def public_functions(spec):
    """A call, by the arrays' names, and valid arrays for each public function that takes some."""
    agent, buffer = ddpg.make(spec), replay.make(spec, 10)
    learners = {
        "irl": irl.make(spec),
        "trajectories": irl.make(spec, irl.IRLHParams(objective="trajectory")),
        "gail": irl.gail.make(spec),
        "random": irl.controls.random(spec),
    }
    key = jax.random.key(0)
    agent_state = jax.eval_shape(agent.init, key)
    states = {name: jax.eval_shape(learner.init, key) for name, learner in learners.items()}
    seen = {"observation": jnp.zeros((6, 3)), "action": jnp.zeros((6, 2))}
    batch, one = transition(spec, 6)._asdict(), transition(spec)._asdict()
    steps, rest = transition(spec, 2, 6), transition(spec, 6)

    def of_params(function, given):
        return lambda **arrays: jax.eval_shape(lambda state: function(state, arrays), given)

    def hot_start_fit(**arrays):
        length = arrays.pop("length")
        returns = arrays.pop("discounted_return")
        subset = DemonstrationSubset(jnp.zeros(2, jnp.int32), length)
        data = hot_start.HotStartData(Transition(**arrays), returns, subset)
        return jax.eval_shape(
            lambda state: hot_start.fit(
                key,
                agent.networks,
                (state.actor, state.critic),
                data,
                hot_start.HotStartHParams(steps=1),
            ),
            agent_state,
        )

    calls = {
        "act": (
            of_params(lambda state, arrays: agent.act(state, **arrays), agent_state),
            {"observation": seen["observation"]},
        ),
        "value": (of_params(lambda state, arrays: agent.value(state, **arrays), agent_state), seen),
        "agent.update": (
            of_params(lambda state, arrays: agent.update(state, Transition(**arrays)), agent_state),
            batch,
        ),
        "cloning": (
            of_params(
                lambda state, arrays: agent.update(state, rest, Transition(**arrays)), agent_state
            ),
            batch,
        ),
        "replay.add": (
            lambda **arrays: jax.eval_shape(
                lambda: buffer.add(buffer.init(), Transition(**arrays))
            ),
            one,
        ),
        "hot_start.fit": (
            hot_start_fit,
            batch | {"discounted_return": jnp.zeros(6), "length": jnp.ones(2, jnp.int32)},
        ),
    }
    for name, learner in learners.items():
        calls[f"{name}.reward"] = (
            of_params(
                lambda state, arrays, learner=learner: learner.reward(state, **arrays), states[name]
            ),
            seen,
        )
        if name != "random":
            whole = steps if name == "trajectories" else rest
            leading = whole.reward.shape
            given = {
                name: leaf
                for name, leaf in whole._asdict().items()
                if name in ("observation", "action", "terminated")
            } | {"log_density": jnp.zeros(leading[0]), "mask": jnp.ones(leading, bool)}

            def update(state, arrays, learner=learner, whole=whole):
                arrays = dict(arrays)
                rest = {name: arrays.pop(name) for name in ("log_density", "mask")}
                return learner.update(state, whole, RewardBatch(whole._replace(**arrays), **rest))

            calls[f"{name}.update"] = of_params(update, states[name]), given
    return calls


def component_functions(spec):
    batch, key = transition(spec, 6)._asdict(), jax.random.key(0)
    seen = {name: batch[name] for name in ("observation", "action")}
    one, step = jnp.ones(()), jnp.zeros((), jnp.int32)
    shaped = dict.fromkeys(("environment_reward", "before", "after"), batch["reward"])
    ring = episodes.make(3, 10, 5)
    subset = {"start": jnp.zeros(2, jnp.int32), "length": jnp.ones(2, jnp.int32)}

    def sample(**subset):
        pool = transition(spec, 6)
        return demonstrations.sample(key, pool, DemonstrationSubset(**subset), 4)

    def plan(step):
        return schedules.plan(step, schedules.Schedule(), schedules.RewardSchedule())

    calls = {
        "additive": (
            shaping.additive,
            dict.fromkeys(("environment_reward", "learned_reward"), batch["reward"])
            | {"weight": one},
        ),
        "potential": (
            shaping.potential,
            shaped | {"terminated": batch["terminated"], "weight": one, "discount": one},
        ),
        "replay.unpack": (
            lambda rows: replay.unpack(spec, rows),
            {"rows": jnp.zeros((6, replay.row_size(spec)))},
        ),
        "demonstrations.sample": (sample, subset),
        "episodes.step": (
            lambda **arrays: ring.step(ring.init(), **arrays),
            {"step": step, "done": jnp.zeros((), bool)},
        ),
        "plan": (plan, {"step": step}),
        "radial_basis": (rewards.radial_basis(spec, 2), seen),
        "fourier": (rewards.fourier(spec, 1), seen),
    }
    network = rewards.mlp(spec)
    params = jax.jit(network.init)(key)
    calls["mlp"] = lambda **arrays: network.apply(params, **arrays), seen
    behaviours = {
        "gaussian": exploration.gaussian(spec),
        "ornstein_uhlenbeck": exploration.ornstein_uhlenbeck(spec),
        "epsilon_greedy": exploration.epsilon_greedy(spec),
        "noisy_epsilon_greedy": exploration.epsilon_greedy(spec, EpsilonGreedyHParams(noise=0.3)),
    }
    for name, behaviour in behaviours.items():
        noise, tree = jax.tree.flatten(behaviour.draw(key))
        state = behaviour.init(key)

        def perturb(action, number, behaviour=behaviour, state=state, tree=tree, **noise):
            noise = jax.tree.unflatten(tree, noise.values())
            return behaviour.perturb(state, action, noise, number)

        def sampled(action, number, behaviour=behaviour, state=state):
            return behaviour.sample(key, state, action, number)

        def log_density(greedy, action, behaviour=behaviour, state=state):
            return behaviour.log_density(state, greedy, action, 0)

        given = {"action": batch["action"][0], "number": one}
        drawn = {f"noise_{index}": leaf for index, leaf in enumerate(noise)}
        calls[f"{name}.perturb"] = perturb, given | drawn
        calls[f"{name}.sample"] = sampled, given
        calls[f"{name}.log_density"] = (
            log_density,
            {"greedy": batch["action"], "action": batch["action"]},
        )
    return calls


def tabular_functions():
    dense = {"dynamics": jnp.full((STATES, ACTIONS, STATES), 1 / STATES)}
    sparse = {
        "next_state": jnp.zeros((STATES, ACTIONS, SUCCESSORS), jnp.int32),
        "probability": jnp.full((STATES, ACTIONS, SUCCESSORS), 1 / SUCCESSORS),
    }
    of_states = {"absorbing": jnp.zeros(STATES, bool), "guess": jnp.zeros(STATES)}
    reward = {"reward": jnp.zeros((STATES, ACTIONS))}

    def sparsely(next_state, probability, **arrays):
        dynamics = tabular.SparseDynamics(next_state, probability)
        return tabular.soft_value_iteration(dynamics, discount=0.9, **arrays)

    def visits(dynamics, log_probabilities, **arrays):
        zeros = jnp.zeros(())
        policy = tabular.SoftPolicy(log_probabilities, zeros, zeros, zeros)
        return tabular.expected_visitation(dynamics, policy, discount=0.9, **arrays)

    def fit(dynamics, features, visitation, initial, absorbing):
        demonstrations = tabular.TabularDemonstrations(visitation, initial)
        return tabular.maxent_irl(
            dynamics, features, demonstrations, discount=0.9, absorbing=absorbing, steps=1
        )

    visited = {
        "visitation": jnp.full((STATES, ACTIONS), 10 / (STATES * ACTIONS)),
        "initial": jnp.full(STATES, 1 / STATES),
        "absorbing": of_states["absorbing"],
    }
    return {
        "soft": (
            abstract(lambda **a: tabular.soft_value_iteration(discount=0.9, **a)),
            dense | reward | of_states,
        ),
        "soft, sparse": (abstract(sparsely), sparse | reward | of_states),
        "hard": (
            abstract(lambda **a: tabular.value_iteration(discount=0.9, **a)),
            dense | reward | {"absorbing": of_states["absorbing"]},
        ),
        "visitation": (
            abstract(visits),
            dense
            | of_states
            | {
                "log_probabilities": jnp.zeros((STATES, ACTIONS)),
                "initial": visited["initial"],
            },
        ),
        "maxent": (
            abstract(fit),
            dense | visited | {"features": jnp.zeros((STATES, ACTIONS, 7))},
        ),
    }


ANY_NUMBERS = (
    *("log_density", "discounted_return", "log_probabilities"),
    *("weight", "discount", "number"),
)
"""Arguments that may be integers as well as floats."""


def takes_any_leading_axes(function):
    return function in ("act", "replay.unpack") or function.endswith(".log_density")


def wrong_arrays(name, array):
    """Arrays that have another shape than `array`, or another kind of dtype."""
    if array.ndim:
        yield array[0]
        yield np.concatenate([array, array[:1]])
    yield array[None]
    yield array[..., None]
    if name not in ANY_NUMBERS:
        yield array.astype(np.int32 if np.issubdtype(array.dtype, np.floating) else np.float32)


def test_public_functions_accept_valid_arrays_and_name_the_shape_or_dtype_of_others(skewed_spec):
    refusals = 0
    functions = public_functions(skewed_spec)
    for name, (call, right) in component_functions(skewed_spec).items():
        functions[name] = abstract(call), right
    for function, (call, right) in (functions | tabular_functions()).items():
        call(**right)
        # Not every wrong array is worth a program.
        right = jax.device_get(right)
        for name, array in right.items():
            for wrong in wrong_arrays(name, array):
                same = (wrong.shape[-1:], wrong.dtype) == (array.shape[-1:], array.dtype)
                if same and takes_any_leading_axes(function):
                    continue
                said = f"{function}({name}={wrong.dtype}{wrong.shape}): "
                try:
                    call(**right | {name: wrong})
                except (ValueError, TypeError) as error:
                    said += str(error)
                _, message = said.split(": ", 1)
                assert str(wrong.shape) in message or str(wrong.dtype) in message, said
                refusals += 1
    assert refusals > 500


def test_shapes_under_vmap_are_those_of_one_seed(skewed_spec):
    agent = ddpg.make(skewed_spec)
    states = jax.eval_shape(jax.vmap(agent.init), jax.random.split(jax.random.key(0), 5))
    batch = jax.eval_shape(lambda: transition(skewed_spec, 5, 6))
    jax.eval_shape(jax.vmap(agent.update), states, batch)
    wrong = jax.ShapeDtypeStruct((5, 7), jnp.float32)
    with pytest.raises(ValueError, match="batch: expected leaves"):
        jax.eval_shape(jax.vmap(agent.update), states, batch._replace(reward=wrong))


@pytest.mark.parametrize("size", ["cells", "steps", "batch_size"])
def test_sizes_of_a_hot_start_are_positive(skewed_spec, size):
    networks = ddpg.make(skewed_spec).networks
    with pytest.raises(ValueError, match=f"{size} must be at least 1, got 0"):
        hot_start.fit(
            jax.random.key(0), networks, ({}, {}), None, hot_start.HotStartHParams(**{size: 0})
        )


@pytest.mark.parametrize("solve", [tabular.soft_value_iteration, tabular.value_iteration])
def test_a_horizon_of_zero_is_refused(solve):
    with pytest.raises(ValueError, match="horizon must be at least 1, got 0"):
        solve(np.full((2, 2, 2), 0.5), np.zeros((2, 2)), discount=1.0, horizon=0)


@pytest.mark.parametrize("check", [checks.sizes, checks.counts])
def test_sizes_are_whole_numbers(check):
    check(size=1, other=np.int64(3))
    for wrong in (2.5, np.float32(2.5), jnp.float32(2.5), "2.5"):
        with pytest.raises(TypeError, match=r"size: expected an integer, got 2\.5"):
            check(size=wrong)
    with pytest.raises(ValueError, match=r"size must be at least \d, got -1"):
        check(size=jnp.int32(-1))


def test_an_array_is_refused_by_its_size_before_it_is_made():
    checks.array_size("it", (2**14, 2**14), "")
    # Neither numpy's integers nor a float hold the last two.
    for shape, size in (
        ((2**14, 2**14 + 1), "2.68e+8 numbers (1.00 GiB in float32)"),
        ((np.int64(2**40),) * 2, "1.21e+24 numbers (4.50e+15 GiB in float32)"),
        ((41,) * 376, "2.55e+606 numbers (9.50e+597 GiB in float32)"),
    ):
        line = f"it would be {size}, more than 2^28: take less"
        with pytest.raises(ValueError, match=f"^{re.escape(line)}$"):
            checks.array_size("it", shape, "take less")


@pytest.mark.parametrize("wrong", [-0.1, 1.1, float("nan"), np.float32(2.0)])
def test_shares_are_between_0_and_1(wrong):
    checks.shares(share=0, other=1.0)
    with pytest.raises(ValueError, match=r"share must be between 0 and 1, got"):
        checks.shares(share=wrong)


@pytest.mark.parametrize("wrong", [0, -1.0, float("nan"), float("inf")])
def test_positive_numbers_are_finite(wrong):
    checks.positive(scale=1, other=1e-3)
    with pytest.raises(ValueError, match=r"scale must be positive and finite, got"):
        checks.positive(scale=wrong)


def test_every_entry_of_an_array_on_the_host_is_checked():
    checks.within(ranges.SHARE, grid=np.array([[0.0, 1.0]]))
    with pytest.raises(ValueError, match=r"^grid must be between 0 and 1, got 2\.0 at \[1, 0\]$"):
        checks.within(ranges.SHARE, grid=jnp.array([[0.0, 1.0], [2.0, jnp.nan]]))


def test_traced_values_pass():
    def check(number):
        checks.sizes(number=number)
        checks.shares(number=number)
        checks.positive(number=number)
        checks.within(ranges.SHARE, number=number)
        return number

    assert jax.jit(check)(-5) == -5


def test_checked_functions_do_not_compile_again_for_other_values(skewed_spec):
    functions = component_functions(skewed_spec)
    for name in ("additive", "potential", "replay.unpack", "fourier", "gaussian.sample"):
        call, right = functions[name]
        compiled = jax.jit(lambda arrays, call=call: call(**arrays))
        compiled(right)
        compiled({name: jnp.zeros_like(leaf) for name, leaf in right.items()})
        assert compiled._cache_size() == 1, name
