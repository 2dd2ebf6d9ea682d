"""DDPG inside one's own scan: agent, replay and noise are pure functions over pytrees."""

import jax
import jax.numpy as jnp

import cmedirl_jax as cm


def make_train(env, steps, batch_size=32, learning_starts=200):
    """`key -> (agent's state, rewards [steps])`: jit, vmap and differentiate it as you like."""
    hparams = cm.ddpg.DDPGHParams(discount=0.95, actor_learning_rate=1e-3)
    agent = cm.ddpg.make(env.spec, hparams)
    noise = cm.exploration.gaussian(env.spec, cm.exploration.GaussianHParams(scale=0.3))
    buffer, params = cm.replay.make(env.spec, capacity=steps), env.default_params

    def train(key):
        keys = jax.random.split(key, 4)
        start = (agent.init(keys[0]), buffer.init(), noise.init(keys[1]))

        def one(carry, numbered):
            learner, memory, behaviour, state, seen = carry
            number, key = numbered
            act_key, step_key, reset_key, batch_key = jax.random.split(key, 4)

            # Act, and remember.
            greedy = agent.act(learner, seen)
            action, _, behaviour = noise.sample(act_key, behaviour, greedy, number)
            after, answer = env.step(step_key, state, action, params)
            reached = (answer.reward, answer.observation, answer.terminated)
            memory = buffer.add(memory, cm.Transition(seen, action, *reached))

            # Learn.
            updated, _ = agent.update(learner, buffer.sample(batch_key, memory, batch_size))
            ready = number >= learning_starts
            learner = jax.tree.map(lambda new, old: jnp.where(ready, new, old), updated, learner)

            # Begin anew where an episode ends.
            done = answer.terminated | answer.truncated
            fresh = env.reset(reset_key, params)
            state, seen = jax.tree.map(
                lambda new, old: jnp.where(done, new, old), fresh, (after, answer.observation)
            )
            return (learner, memory, behaviour, state, seen), answer.reward

        numbered = (jnp.arange(steps), jax.random.split(keys[2], steps))
        carry, rewards = jax.lax.scan(one, (*start, *env.reset(keys[3], params)), numbered)
        return carry[0], rewards

    return train


def main(steps=6_000, seeds=4):
    """Mean reward of a step in the first and the last tenth of the training."""
    train = make_train(cm.envs.make("Pendulum-v1"), steps)
    _, rewards = jax.jit(jax.vmap(train))(jax.random.split(jax.random.key(0), seeds))
    return jnp.mean(rewards[:, : steps // 10]), jnp.mean(rewards[:, -steps // 10 :])


if __name__ == "__main__":
    print("mean reward of a step: {:.2f} at first, {:.2f} at last".format(*main()))
