"""Independent float64 references: perceptrons, gradients by differences, integrals over actions."""

import itertools

import jax
import numpy as np


def mlp(params, x, joined=None, *, normalise=False):
    """The forward pass of `networks.MLP`, the second input joining at the first layer."""
    layers = params["params"]
    x = x if joined is None else np.concatenate([x, joined], axis=-1)
    for index in range(len(layers)):
        layer = layers[f"Dense_{index}"]
        x = x @ layer["kernel"] + layer["bias"]
        if index < len(layers) - 1:
            if normalise:
                deviation = x - x.mean(axis=-1, keepdims=True)
                x = deviation / np.sqrt((deviation**2).mean(axis=-1, keepdims=True) + 1e-5)
            x = np.maximum(x, 0.0)
    return x


def float64(tree):
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), tree)


def gradient(loss, params, step=1e-6):
    """Central differences of `loss(params)` by every number in `params`."""
    leaves, structure = jax.tree.flatten(float64(params))

    def at(leaf_index, position, offset):
        moved = [leaf.copy() for leaf in leaves]
        moved[leaf_index][position] += offset
        return loss(jax.tree.unflatten(structure, moved))

    slopes_by_leaf = []
    for leaf_index, leaf in enumerate(leaves):
        slopes = np.zeros_like(leaf)
        for position in np.ndindex(leaf.shape):
            rise = at(leaf_index, position, step) - at(leaf_index, position, -step)
            slopes[position] = rise / (2 * step)
        slopes_by_leaf.append(slopes)
    return jax.tree.unflatten(structure, slopes_by_leaf)


def base_measure(spec, n=200, *, atoms=True):
    """Actions `[M, A]` and weights `[M]` of the integral over the bounds (and a mass at each)."""
    node, weight = np.polynomial.legendre.leggauss(n)
    axes = []
    for low, high in np.float64(np.stack([spec.action_low, spec.action_high], axis=-1)):
        half_width = 0.5 * (high - low)
        axis = list(zip(low + half_width * (node + 1), half_width * weight, strict=True))
        axes.append(axis + [(low, 1.0), (high, 1.0)] * atoms)
    points = np.array(list(itertools.product(*axes)))  # [M, A, 2]
    return points[..., 0], points[..., 1].prod(axis=-1)
