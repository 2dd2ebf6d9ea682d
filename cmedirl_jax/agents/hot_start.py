"""Hot start of actor and critic from demonstrations (the paper, section 3.4 and Eq. 11).

    data = hot_start.data(pool, discount=0.99)
    params = hot_start.fit(key, agent.networks, params, data)
    state = agent.init(key, params)

The actor is regressed on the demonstrated actions. The critic is a 'DAQN': its values at actions
a_1..K are fitted to a target that singles out the demonstrated action. These actions are evenly
spaced along one dimension of the action, while the other dimensions keep their demonstrated values;
the loss is the mean over the dimensions. A pair thus takes K A actions, where a full grid would
take K^A. With one dimension the two are the same. With more, softmaxes along the dimensions are the
marginals of the softmax over a full grid wherever Q is a sum of functions of one dimension each.

The paper's loss (a softmax over actions, a squared error to a one-hot array) is not defined for a
continuous critic. `HotStartHParams.critic` chooses among three readings of it and two other losses:

- "softmax" (H0, the letter): sum_k [softmax(Q(s, a_1..K))_k - 1{k = demonstrated cell}]^2
- "one-hot" (H1): sum_k [Q(s, a_k) - 1{k = demonstrated cell}]^2, where the demonstrated action
  itself replaces the cell nearest to it
- "quadratic" (H2): sum_k [Q(s, a_k) - (G(s) - curvature |a_k - a_demo|^2)]^2, with G the discounted
  return of the rest of the demonstration, so that values are on the scale of returns
- "monte-carlo" (H3): [Q(s, a_demo) - G(s)]^2, on the demonstrated action alone
- "large-margin" (H4, as in DQfD, Hester et al. 2018): max_k [Q(s, a_k) + margin 1{k != demonstrated
  cell}] - Q(s, a_demo), at the actions of "one-hot"; it does not fix the level of Q
"""

import functools
from typing import Any, Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax

from cmedirl_jax import checks, observation_statistics, ranges
from cmedirl_jax import networks as networks_lib
from cmedirl_jax.data import demonstrations as demonstrations_lib
from cmedirl_jax.data.hot_start_data import HotStartData, prepare
from cmedirl_jax.networks import ActorCritic
from cmedirl_jax.ranges import NotNegative, Size
from cmedirl_jax.types import Demonstrations, DemonstrationSubset, EnvSpec, Params

data = prepare
"""See `data.hot_start_data.prepare`."""


class HotStartHParams(flax.struct.PyTreeNode):
    """Hyperparameters. Strings and sizes are static.

    Attributes:
        learning_rate: Adam's rate for both networks, per gradient step.
        curvature: For the "quadratic" target: fall of the value per squared half-width of the
            action range.
        margin: For the "large-margin" loss: by how much the demonstrated action's value has to
            exceed the others, in units of the value.
        critic: The critic's loss, in the order H0 to H4 of `agents.hot_start`.
        cells: K, evenly spaced values along each action dimension, bounds included.
        steps: Gradient steps on each network.
        batch_size: Demonstrated environment steps per gradient step.
    """

    learning_rate: NotNegative = 1e-3
    curvature: NotNegative = 20.0
    margin: NotNegative = 0.8
    critic: Literal["softmax", "one-hot", "quadratic", "monte-carlo", "large-margin"] = (
        flax.struct.field(pytree_node=False, default="one-hot")
    )
    cells: Size = flax.struct.field(pytree_node=False, default=11)
    steps: Size = flax.struct.field(pytree_node=False, default=1000)
    batch_size: Size = flax.struct.field(pytree_node=False, default=32)


def fit(
    key: jax.Array,
    networks: ActorCritic,
    params: tuple[Params, Params],
    demonstrations: Demonstrations | HotStartData,
    hparams: HotStartHParams | None = None,
    *,
    subset: DemonstrationSubset | None = None,
) -> tuple[Params, Params]:
    """Fit actor and critic to demonstrations by supervised learning, with fresh optimisers.

    Then call `agent.init(key, params)`, which copies the result to the targets.

    Args:
        key: randomness of the minibatches.
        networks: the actor and the critic.
        params: their parameters `(actor, critic)` to start from.
        demonstrations: the pool. Prepare it with `data` first under jit or vmap, or for an agent
            whose discount is not 0.99.
        hparams: hyperparameters.
        subset: the learner's own episodes of the pool; default all.

    Returns:
        The fitted `(actor, critic)`.

    Raises:
        ValueError: if the pool is not valid or does not fit the networks, a number of `hparams` is
            out of range, or the subset is not of the pool.
        TypeError: if a leaf of a prepared pool has a wrong dtype, or the subset is not of integers.
    """
    hparams = hparams or HotStartHParams()
    ranges.check(hparams)
    if isinstance(demonstrations, Demonstrations):
        demonstrations = prepare(demonstrations)
    pool = jax.tree.map(jnp.asarray, demonstrations)
    chosen = pool.episodes if subset is None else subset
    size = pool.transition.observation.shape[:1]
    checks.transition_shapes(networks.spec, pool.transition, size, "demonstrations")
    checks.shape("discounted_return", pool.discounted_return, size)
    demonstrations_lib.check_subset(chosen, *size)

    optimizer = optax.adam(hparams.learning_rate)
    step = functools.partial(_step, networks, hparams, optimizer, pool, chosen)
    keys = jax.random.split(key, hparams.steps)
    (fitted, _), _ = jax.lax.scan(step, (params, optimizer.init(params)), keys)
    return fitted


def _step(
    networks: ActorCritic,
    hparams: HotStartHParams,
    optimizer: optax.GradientTransformation,
    pool: HotStartData,
    chosen: DemonstrationSubset,
    carry: tuple[Any, optax.OptState],
    key: jax.Array,
) -> tuple[tuple[Any, optax.OptState], None]:
    """Take a gradient step of both networks on a minibatch."""
    params, state = carry
    index = demonstrations_lib.sample_index(key, chosen, hparams.batch_size)
    grads, params = jax.grad(_loss, has_aux=True)(params, networks, hparams, pool, index)
    updates, state = optimizer.update(grads, state, params)
    return (optax.apply_updates(params, observation_statistics.fixed(updates)), state), None


def _loss(
    params: tuple[Params, Params],
    networks: ActorCritic,
    hparams: HotStartHParams,
    pool: HotStartData,
    index: jax.Array,
) -> tuple[jax.Array, tuple[Params, Params]]:
    """The sum of both losses. They share no parameters, so each network gets its own gradient."""
    actor, critic = params
    observation = pool.transition.observation[index]
    action = pool.transition.action[index]
    actor_error, actor = networks_lib.imitation_error(networks, actor, observation, action)
    critic_error, critic = critic_loss(
        networks, critic, hparams, observation, action, pool.discounted_return[index]
    )
    return actor_error + critic_error, (actor, critic)


def critic_loss(
    networks: ActorCritic,
    critic: Params,
    hparams: HotStartHParams,
    observation: jax.Array,
    action: jax.Array,
    discounted_return: jax.Array,
) -> tuple[jax.Array, Params]:
    """The loss `[]` that `hparams.critic` names (see above), and the parameters.

    Args:
        networks: the critic, and the sizes and bounds of the environment.
        critic: its parameters.
        hparams: which loss, how many cells, the curvature, the margin.
        observation: `[B, O]`.
        action: `[B, A]`, demonstrated.
        discounted_return: `[B]`, G(s), which only "quadratic" and "monte-carlo" read.
    """
    evaluate = networks_lib.train_mode(networks.critic)
    if hparams.critic == "monte-carlo":
        q, critic = evaluate(critic, observation, action)
        return jnp.mean(jnp.square(q - discounted_return)), critic

    # N = B A lines, one for each pair and dimension.
    spec = networks.spec
    actions, nearest, squared_distance = _lines(spec, hparams, action)
    along = functools.partial(jnp.repeat, repeats=spec.action_dim, axis=0)
    observations = jnp.broadcast_to(
        along(observation)[:, None], (*nearest.shape, spec.observation_dim)
    )
    q, critic = evaluate(critic, observations, actions)

    # The loss of each line [N].
    match hparams.critic:
        case "softmax":
            error = _squared_error(jax.nn.softmax(q, axis=-1), nearest)
        case "one-hot":
            error = _squared_error(q, nearest)
        case "quadratic":
            target = along(discounted_return)[:, None] - hparams.curvature * squared_distance
            error = _squared_error(q, target)
        case "large-margin":
            best = jnp.max(q + hparams.margin * (1.0 - nearest), axis=-1)
            error = best - jnp.sum(nearest * q, axis=-1)
    return jnp.mean(error), critic


def _lines(
    spec: EnvSpec, hparams: HotStartHParams, action: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The grid along each dimension of actions `[B, A]`, the other dimensions as they are.

    Returns:
        actions `[N, K, A]`, `N = B A`, the dimension fastest; one-hot arrays `[N, K]` of the
        cell that the demonstrated action is in; and squared distances to that action `[N, K]`,
        in half-widths of the action range.
    """
    size, dims = action.shape
    cells = jnp.tile(action_cells(spec, hparams.cells), (size, 1))
    half_width = jnp.tile(0.5 * (spec.action_high - spec.action_low), size)
    demonstrated = action.reshape(-1, 1)
    squared_distance = jnp.square((cells - demonstrated) / half_width[:, None])
    nearest = jax.nn.one_hot(
        jnp.argmin(squared_distance, axis=-1), hparams.cells, dtype=jnp.float32
    )
    if hparams.critic in ("one-hot", "large-margin"):
        cells = jnp.where(nearest > 0, demonstrated, cells)
    moved = jnp.tile(jnp.eye(dims, dtype=bool), (size, 1))
    others = jnp.repeat(action, dims, axis=0)
    actions = jnp.where(moved[:, None], cells[..., None], others[:, None])
    return actions, nearest, squared_distance


def _squared_error(q: jax.Array, target: jax.Array) -> jax.Array:
    """Summed over the cells: `[N, K]` -> `[N]`."""
    return jnp.sum(jnp.square(q - target), axis=-1)


def action_cells(spec: EnvSpec, cells: int) -> np.ndarray:
    """`cells` evenly spaced values along each action dimension, bounds included: `[A, cells]`."""
    return np.linspace(spec.action_low, spec.action_high, cells, axis=-1)
