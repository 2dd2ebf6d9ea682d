"""Population-based training of 64 agents: hyperparameters are leaves, and are bred like weights."""

import functools

import jax
import jax.numpy as jnp

import cmedirl_jax as cm

AGENTS, RATES = 64, ("actor_learning_rate", "critic_learning_rate")


def breed(key, agents, returns):
    """The worse half become copies of the better half, with learning rates of their own."""
    order = jnp.argsort(-returns)
    better, worse = jnp.split(order, 2)
    agents = jax.tree.map(lambda leaf: leaf.at[worse].set(leaf[better]), agents)
    factors = jnp.exp(0.5 * jax.random.normal(key, (2, len(worse))))
    rates = {
        name: getattr(agents.hparams, name).at[worse].multiply(factor)
        for name, factor in zip(RATES, factors, strict=True)
    }
    return agents.replace(hparams=agents.hparams.replace(**rates))


def make_train(env, generations, steps):
    """`key -> returns [generations, AGENTS]`, after so many more steps each."""
    trainer = cm.training.make(env, cm.METHODS["ddpg"], capacity=generations * steps)

    def live(state, numbers):
        state, _ = trainer.run(state, None, numbers)
        act = functools.partial(trainer.act, state.agent.actor)
        return state, cm.evaluation.evaluate(act, env, env.default_params, 5).return_mean

    def generation(states, numbered):
        first, key = numbered
        states, returns = cm.seeds.map_groups(live, 8)(states, first + jnp.arange(steps))
        return states.replace(agent=breed(key, states.agent, returns)), returns

    def train(key):
        keys = jax.random.split(key, AGENTS + 2)
        states = jax.vmap(lambda key: trainer.init(key, None, 0))(keys[2:])
        rates = 10.0 ** jax.random.uniform(keys[0], (2, AGENTS), minval=-6.0, maxval=-1.0)
        hparams = states.agent.hparams.replace(**dict(zip(RATES, rates, strict=True)))
        states = states.replace(agent=states.agent.replace(hparams=hparams))
        numbered = (steps * jnp.arange(generations), jax.random.split(keys[1], generations))
        return jax.lax.scan(generation, states, numbered)[1]

    return train


def main(generations=8, steps=400):
    """The mean return of the population in the first and in the last generation."""
    env = cm.envs.make("Pendulum-v1")
    returns = jax.jit(make_train(env, generations, steps))(jax.random.key(0))
    return returns[0].mean(), returns[-1].mean()


if __name__ == "__main__":
    print("return: {:.0f} in the first generation, {:.0f} in the last".format(*main()))
