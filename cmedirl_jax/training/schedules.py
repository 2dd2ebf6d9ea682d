"""What each environment step does: learn, move the targets, learn the reward, and how much.

All of it follows from the step's number alone, which all seeds share. So the predicates are not
batched under `vmap`, and `lax.cond` on them stays a branch.
"""

import dataclasses
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import checks, ranges
from cmedirl_jax.irl.shaping import Shaping
from cmedirl_jax.ranges import Count, Size

Cloning = Literal["none", "constant", "annealed"]


@dataclasses.dataclass(frozen=True)
class RewardSchedule:
    """When the reward is learned, and how r_D is used. All static.

    Attributes:
        period: Environment steps between updates of the reward.
        iterations: Iterations K of Algorithm 1 at each update.
        stop: Environment step from which r_D is frozen (and kept); None: never.
        anneal_steps: Environment steps over which the weight of r_D falls linearly to 0; None:
            stays 1.
        storage: Compute r_D anew when a transition is sampled, or store r* = r_D + r_e at
            collection.
        shaping: How r_D joins r_e in a method that adds them: r_e + r_D, r_e + gamma Phi(s') -
            Phi(s) with r_D(s) for Phi, or r_D alone; None: as the method says.
    """

    period: Size = 4
    iterations: Size = 1
    stop: Count | None = 2000
    anneal_steps: Size | None = None
    storage: Literal["recompute", "store"] = "recompute"
    shaping: Shaping | None = None


@dataclasses.dataclass(frozen=True)
class Schedule:
    """The training loop.

    Attributes:
        batch_size: Transitions per update.
        replay_capacity: Transitions the replay holds; None: every one of the run.
        recent: Latest transitions that the agent's minibatches are drawn from; None: all that the
            replay holds. A learned reward draws its background by reward_batches.recent.
        learning_starts: Environment steps before the first update.
        update_period: Environment steps between updates of actor and critic.
        target_period: Environment steps between target updates (the paper: 300, with agent.tau 1).
        frozen_actor_steps: Environment steps for which a hot-started actor is not updated, while
            the critic learns.
        cloning: How agent.behaviour_cloning of a hot-started method goes on: left out, at its full
            weight, or falling linearly to 0.
        behaviour_cloning_steps: Environment steps over which "annealed" cloning falls.
    """

    batch_size: Size = 32
    replay_capacity: Size | None = None
    recent: Size | None = None
    learning_starts: Count = 200
    update_period: Size = 1
    target_period: Size = 1
    frozen_actor_steps: Count = 0
    cloning: Cloning = "annealed"
    behaviour_cloning_steps: Size = 4000


class Plan(NamedTuple):
    """What a step does, all `[]`.

    Attributes:
        step: its number.
        learn: update actor and critic.
        update_actor: a hot-started actor takes part in that update.
        update_targets: move the targets at that update.
        learn_reward: update the learned reward.
        reward_weight: weight of r_D beside r_e.
        cloning_weight: factor on a hot-started method's cloning term; other methods have none.
    """

    step: jax.Array
    learn: jax.Array
    update_actor: jax.Array
    update_targets: jax.Array
    learn_reward: jax.Array
    reward_weight: jax.Array
    cloning_weight: jax.Array


def plan(step: jax.Array, schedule: Schedule, reward_schedule: RewardSchedule) -> Plan:
    """What environment step `step` (`[]` int32) does.

    Raises:
        ValueError: if `step` is not a scalar, or a number of the schedules is out of its range.
        TypeError: if `step` is not an integer.
    """
    checks.shape("step", step, ())
    checks.kind("step", step, jnp.integer)
    ranges.check(schedule)
    ranges.check(reward_schedule)
    learns = step >= schedule.learning_starts
    learn_reward = learns & (step % reward_schedule.period == 0)
    if reward_schedule.stop is not None:
        learn_reward &= step < reward_schedule.stop
    reward_weight = jnp.ones_like(step, jnp.float32)
    if reward_schedule.anneal_steps is not None:
        reward_weight = _falling(step, reward_schedule.anneal_steps)
    return Plan(
        step=step,
        learn=learns & (step % schedule.update_period == 0),
        update_actor=step >= schedule.frozen_actor_steps,
        # True where a multiple was passed since the last update.
        update_targets=step % schedule.target_period < schedule.update_period,
        learn_reward=learn_reward,
        reward_weight=reward_weight,
        cloning_weight=_cloning_weight(step, schedule),
    )


def _cloning_weight(step: jax.Array, schedule: Schedule) -> jax.Array:
    match schedule.cloning:
        case "none":
            return jnp.zeros_like(step, jnp.float32)
        case "constant":
            return jnp.ones_like(step, jnp.float32)
        case "annealed":
            return _falling(step, schedule.behaviour_cloning_steps)


def _falling(step: jax.Array, steps: int) -> jax.Array:
    """From 1 at step 0 to 0 at `steps`, linearly."""
    return jnp.maximum(1.0 - step / jnp.float32(steps), 0.0)
