"""Independent float64 references: perceptrons in numpy, gradients by central differences."""

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

    found = []
    for leaf_index, leaf in enumerate(leaves):
        slopes = np.zeros_like(leaf)
        for position in np.ndindex(leaf.shape):
            rise = at(leaf_index, position, step) - at(leaf_index, position, -step)
            slopes[position] = rise / (2 * step)
        found.append(slopes)
    return jax.tree.unflatten(structure, found)
