"""The data term of the likelihood, as the gradient it has with respect to the rewards."""

import jax
import jax.numpy as jnp


def visitation_difference(
    demonstrations: int, background: int, *, append: bool
) -> tuple[jax.Array, jax.Array]:
    """dL_D/dr = mu_D - E[mu] on the sampled state-action pairs (Eq. 6, Eq. 8).

    An estimate, undiscounted. The background samples stand in for those of the soft-optimal policy
    of the current reward, without importance weights, which biases it; and weights that are linear
    in the reward have no partition function to hold the reward back, which is why `IRLHParams` has
    a bound and a penalty.

    mu_D is the empirical distribution of the demonstration batch. E[mu] is estimated by that of the
    background batch: the demonstrations together with the samples where `append` (Algorithm 1, line
    4), or the samples alone. With these uniform weights the two differ only in the factor
    `background / (background + demonstrations)` on the whole difference.

    Args:
        demonstrations: pairs in the demonstration batch.
        background: pairs in the background batch.
        append: whether the demonstrations join the background.

    Returns:
        The derivative by the reward of each demonstrated pair `[demonstrations]` and of each
        background pair `[background]`; together they sum to zero.
    """
    total = background + demonstrations if append else background
    expected_on_demonstrations = 1.0 / total if append else 0.0
    return (
        jnp.full((demonstrations,), 1.0 / demonstrations - expected_on_demonstrations),
        jnp.full((background,), -1.0 / total),
    )
