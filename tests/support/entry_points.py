"""What a user calls, as small functions of a key and a batch, for the table of `test_modes`.

Each function makes what it calls, as a program that has set a mode of JAX would, and passes states
through twice, so that a state whose type changes is refused by the loop.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import cmedirl_jax as cm
from cmedirl_jax.agents.exploration import EpsilonGreedyHParams, ExplorationSettings
from cmedirl_jax.agents.hot_start import HotStartHParams
from cmedirl_jax.irl import IRLHParams
from cmedirl_jax.irl.reward_batches import RewardBatchSettings, SampleDraws
from cmedirl_jax.irl.rewards import RewardNetworkSettings
from cmedirl_jax.networks import Architecture
from cmedirl_jax.tabular.imitation import TabularSettings
from cmedirl_jax.training.schedules import RewardSchedule, Schedule
from cmedirl_jax.types import DemonstrationSubset, RewardBatch
from tests.support import pools
from tests.support.agents import random_batch

SIZE, LIMIT, STEP = 4, 3, np.int32(5)
ENV = pools.ENV._replace(
    spec=pools.ENV.spec._replace(max_episode_steps=LIMIT),
    default_params=pools.ENV.default_params.replace(max_episode_steps=LIMIT),
)
SPEC, PARAMS = ENV.spec, ENV.default_params
BATCH = jax.tree.map(np.asarray, random_batch(jax.random.key(2), SIZE))
POOL = pools.random_pool([2, 3, 1])
DATA = cm.hot_start.data(POOL)
SUBSET = DemonstrationSubset(np.int32([0, 2]), np.int32([2, 3]))
SETTINGS = cm.Settings(
    architecture=Architecture(hidden=(3,)),
    schedule=Schedule(batch_size=SIZE, learning_starts=1, target_period=2),
    reward_network=RewardNetworkSettings(hidden=(3,)),
    reward_batches=RewardBatchSettings(batch_size=SIZE),
    reward_schedule=RewardSchedule(period=2),
    hot_start=HotStartHParams(steps=2, batch_size=SIZE, cells=3),
    tabular=TabularSettings(states=3, actions=2, steps=1, centres=2, hidden=(3,)),
)
NETWORKS = functools.partial(cm.networks.make, SPEC, SETTINGS.architecture)
REWARD = functools.partial(cm.rewards.mlp, SPEC, (3,))


def twice(step, state, key):
    """Two steps `(state, key) -> (state, output)` in a loop."""
    return jax.lax.scan(step, state, jax.random.split(key))


# The task and the data.


def environment(key, batch):
    keys = jax.random.split(key)
    state, observation = ENV.reset(keys[0], PARAMS)
    action = batch.action[0]
    stepped = twice(lambda state, key: ENV.step(key, state, action, PARAMS), state, keys[1])
    return observation, stepped, ENV.starts(3, PARAMS), ENV.state_at(batch.observation[0], PARAMS)


def replay(key, batch):
    made = cm.replay.make(SPEC, 3)
    row = jax.tree.map(lambda leaf: leaf[0], batch)
    state = made.add(made.init(), row)
    state = made.add(made.add(state, row), row)
    return state, made.sample(key, state, SIZE, recent=2)


def episodes(key, batch):
    made = cm.episodes.make(2, 8, LIMIT)
    state = made.step(made.init(), STEP, batch.terminated[0])
    return state, made.take(state, jax.random.bits(key, (2,), jnp.uint32), STEP + 1)


def demonstrations(key, batch):
    del batch
    keys = jax.random.split(key, 3)
    whole = cm.demonstrations.episodes(POOL)
    some = cm.demonstrations.subset(keys[0], whole, jnp.int32(1), size=2)
    sampled = cm.demonstrations.sample(keys[1], POOL.transition, some, SIZE)
    return some, sampled, cm.demonstrations.sample_episodes(keys[2], some, 2)


# The agent.


def networks(architecture, key, batch):
    made, keys = cm.networks.make(SPEC, architecture), jax.random.split(key)
    actor, critic = made.actor.init(keys[0]), made.critic.init(keys[1])
    value, _ = cm.networks.train_mode(made.critic)(critic, batch.observation, batch.action)
    return value, cm.networks.policy(made, actor, batch.observation)


def ddpg(key, batch):
    made, keys = cm.ddpg.make(SPEC, networks=NETWORKS()), jax.random.split(key)
    state, info = twice(lambda state, _: made.update(state, batch), made.init(keys[0]), keys[1])
    action = made.act(state, batch.observation)
    return state, info, action, made.value(state, batch.observation, action)


def ddpg_switches(key, batch):
    made = cm.ddpg.make(SPEC, cm.ddpg.DDPGHParams(q_filter=True), networks=NETWORKS())
    due = dict.fromkeys(("update_actor", "update_targets", "clone"), jnp.asarray(True))
    keys = jax.random.split(key)
    step = functools.partial(made.update, batch=batch, demonstrations=batch, **due)
    return twice(lambda state, _: step(state), made.init(keys[0]), keys[1])


def exploration(settings, key, batch):
    made, keys = cm.exploration.make(SPEC, settings), jax.random.split(key)
    state, action = made.init(keys[0]), batch.action[0]

    def act(state, key):
        taken, density, state = made.sample(key, state, action, STEP)
        return state, (taken, density)

    return twice(act, state, keys[1]), made.log_density(state, action, batch.action, STEP)


def hot_start(critic, key, batch):
    made, keys = NETWORKS(), jax.random.split(key, 3)
    params = made.actor.init(keys[0]), made.critic.init(keys[1])
    data = DATA._replace(transition=batch, discounted_return=batch.reward)
    hparams = SETTINGS.hot_start.replace(critic=critic)
    subset = SUBSET._replace(length=np.int32([2, 2]))
    return cm.hot_start.fit(keys[2], made, params, data, hparams, subset=subset)


# The reward.


def reward(make, key, batch):
    made, keys = make(), jax.random.split(key)
    state = made.init(keys[0])
    learned = twice(lambda state, key: made.update(state, batch, batch, key=key), state, keys[1])
    return learned, made.reward(state, batch.observation, batch.action)


def reward_of_trajectories(key, batch):
    hparams = IRLHParams(objective="trajectory", discount=0.9, absorbing=True, weight_limit=1.0)
    made = cm.irl.make(SPEC, hparams, network=REWARD())
    transition = jax.tree.map(lambda leaf: leaf.reshape(2, 2, *leaf.shape[1:]), batch)
    whole = RewardBatch(transition, batch.reward[:2], np.ones((2, 2), bool))
    return made.update(made.init(key), whole, whole)


def reward_without_samples(key, batch):
    made = cm.irl.make(SPEC, IRLHParams(weight_exponent=0.0), network=REWARD())
    nothing = RewardBatch(batch, jnp.full(SIZE, jnp.inf, jnp.float32), np.zeros(SIZE, bool))
    return made.update(made.init(key), nothing, nothing)


def background(weights, objective, key, batch):
    nets, buffer = NETWORKS(), cm.replay.make(SPEC, 8)
    behaviour = cm.exploration.gaussian(SPEC)
    settings = RewardBatchSettings(
        SIZE, None, weights, snapshots=2, snapshot_period=2, trajectories=2, episodes=2
    )
    made = cm.background.make(SPEC, nets, behaviour, buffer, 8, settings, objective=objective)
    keys = jax.random.split(key, 5)
    actor, pool = nets.actor.init(keys[0]), POOL.transition
    state = made.init(keys[1], actor, pool, SUBSET)
    state = made.record(state, actor, np.int32(0), batch.reward[0], np.array(True))
    stored = buffer.add(buffer.init(), jax.tree.map(lambda leaf: leaf[0], batch))
    rows, size = np.arange(SIZE, dtype=np.int32), made.batch_size
    draws = SampleDraws(buffer.draw(keys[3], size), made.choose(keys[2], SUBSET, rows, size))
    return state, made.take(state, pool, SUBSET, stored, behaviour.init(keys[4]), draws)


def shaping(key, batch):
    del key
    r_d, over = batch.reward, batch.terminated
    return cm.shaping.additive(r_d, r_d, 0.5), cm.shaping.potential(r_d, r_d, r_d, over, 0.9)


# Training.


def train(method, key, batch):
    del batch
    made = cm.training.make(ENV, cm.METHODS[method], SETTINGS, capacity=8)
    pool = DATA if cm.METHODS[method].uses_demonstrations else None
    networks = made.hot_start(key, pool, 2, made.draw_networks(key))
    state = made.init(key, pool, 2, networks)
    if not cm.METHODS[method].interacts:
        return state
    return made.run(state, pool, jnp.arange(4, dtype=jnp.int32), 2)


def fit(key, batch):
    del batch
    sizes = {"seeds": 2, "steps": 2, "evaluate_every": 2, "evaluation_starts": 2}
    return cm.training.fit(key, ENV, "me-ddpg", POOL, **sizes, settings=SETTINGS)


def evaluation(key, batch):
    del key
    weight = batch.reward[0]
    return cm.evaluation.evaluate(lambda seen: weight * seen[:, :1], ENV, PARAMS, 3)


def seeds(key, batch):
    def step(state, table):
        return (state + jnp.sum(table)).astype(state.dtype), state

    keys = cm.seeds.keys(key, 4)
    state = jax.vmap(functools.partial(jax.random.uniform, dtype=jnp.float32))(keys)
    mapped = cm.seeds.map_groups(lambda *given: step(*given)[0], 2)(state, batch.reward)
    return mapped, cm.seeds.step_groups(step, 2)(state, jnp.int32(1), batch.reward)


def schedules(key, batch):
    del key, batch
    return cm.schedules.plan(STEP, SETTINGS.schedule, RewardSchedule(anneal_steps=3))


def _linear(features, size):
    return cm.irl.make(SPEC, network=cm.rewards.linear(SPEC, features(SPEC, size)))


_bind = functools.partial
_IRL = {
    "visitation": IRLHParams(),
    "absorbing, gauge, penalty": IRLHParams(
        absorbing=True, gauge="zero-mean", gradient_penalty=0.1
    ),
    "transition": IRLHParams(objective="transition", weight_limit=1.0, bounded_by="clip"),
}
_LEARNERS = {
    **{f"irl: {name}": _bind(cm.irl.make, SPEC, hparams) for name, hparams in _IRL.items()},
    "irl: fourier": _bind(_linear, cm.rewards.fourier, 2),
    "irl: radial basis": _bind(_linear, cm.rewards.radial_basis, 2),
    "irl.gail": _bind(cm.irl.gail.make, SPEC),
    "irl.controls.random": _bind(cm.irl.controls.random, SPEC),
    "irl.controls.constant": _bind(cm.irl.controls.constant, 0.1),
}
_EXPLORATIONS = {
    "gaussian": ExplorationSettings("gaussian"),
    "ornstein-uhlenbeck": ExplorationSettings("ornstein-uhlenbeck"),
    "epsilon-greedy": ExplorationSettings("epsilon-greedy"),
    "noisy": ExplorationSettings("epsilon-greedy", epsilon_greedy=EpsilonGreedyHParams(noise=0.1)),
}
_ARCHITECTURES = {
    "layer": Architecture(hidden=(3, 2), actor_normalisation="layer", action_layer=1),
    "batch": Architecture(hidden=(3,), critic_normalisation="batch"),
}
_BATCHES = (("uniform", "trajectory"), ("recorded", "visitation"), ("fusion", "trajectory"))
_CRITICS = ("softmax", "one-hot", "quadratic", "monte-carlo", "large-margin")

ENTRY_POINTS = {
    "envs": environment,
    "replay": replay,
    "episodes": episodes,
    "demonstrations": demonstrations,
    **{f"networks: {name}": _bind(networks, of) for name, of in _ARCHITECTURES.items()},
    "ddpg": ddpg,
    "ddpg: switches": ddpg_switches,
    **{f"exploration: {name}": _bind(exploration, of) for name, of in _EXPLORATIONS.items()},
    **{f"hot_start: {name}": _bind(hot_start, name) for name in _CRITICS},
    **{name: _bind(reward, make) for name, make in _LEARNERS.items()},
    "irl: trajectory": reward_of_trajectories,
    "irl: no samples": reward_without_samples,
    **{f"background: {', '.join(of)}": _bind(background, *of) for of in _BATCHES},
    "shaping": shaping,
    **{f"training: {name}": _bind(train, name) for name in cm.METHODS if "maxent" not in name},
    "training.fit": fit,
    "evaluation": evaluation,
    "seeds": seeds,
    "schedules": schedules,
}
"""By what `import cmedirl_jax as cm` calls it."""
