"""Whether a pool of demonstrations is what it claims to be, on the host, where it enters."""

import numpy as np

from cmedirl_jax import checks
from cmedirl_jax.types import Demonstrations, EnvSpec

_KINDS = {
    "terminated": ("b", "bool"),
    "truncated": ("b", "bool"),
    "episode": ("i", "signed integers"),
}


def validate(demonstrations: Demonstrations, spec: EnvSpec | None = None) -> None:
    """Check a pool, against an environment if `spec` is given.

    Raises:
        ValueError: naming the first mistake: another environment, wrong shapes or dtypes, no
            steps, values that are not finite, actions out of bounds, episodes out of order.
    """
    transition, truncated, episode, metadata = demonstrations
    if spec is not None:
        checks.env_spec(spec)
    if spec is not None and metadata.get("env") != spec.id:
        raise ValueError(f"made for environment {metadata.get('env')!r}, not {spec.id!r}")
    arrays = {**transition._asdict(), "truncated": truncated, "episode": episode}
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    size = arrays["reward"].shape
    if len(size) != 1 or size[0] == 0:
        raise ValueError(f"reward must be [N] with N > 0, got shape {size}")
    for name, array in arrays.items():
        vector = name in ("observation", "next_observation", "action")
        if array.shape[:1] != size or array.ndim != (2 if vector else 1):
            raise ValueError(f"{name} has shape {array.shape}, reward has {size}")
        kind, words = _KINDS.get(name, ("f", "floats"))
        if array.dtype.kind != kind:
            raise ValueError(f"{name} has dtype {array.dtype}, expected {words}")
        if not (np.abs(array) <= np.finfo(np.float32).max).all():
            raise ValueError(f"{name} holds values that are not finite")
    if arrays["observation"].shape != arrays["next_observation"].shape:
        raise ValueError("observation and next_observation differ in shape")
    if spec is not None:
        _validate_sizes(arrays, spec)
    change = np.diff(arrays["episode"].astype(np.int64))
    if arrays["episode"][0] != 0 or not np.isin(change, (0, 1)).all():
        raise ValueError("episode must count 0, 0, ..., 1, 1, ... without gaps")
    ended = arrays["terminated"] | arrays["truncated"]
    if not np.array_equal(ended[:-1], change == 1):
        raise ValueError("each episode but the last must end, and only there, at its last step")


def _validate_sizes(arrays: dict[str, np.ndarray], spec: EnvSpec) -> None:
    for name, dim in (("observation", spec.observation_dim), ("action", spec.action_dim)):
        if arrays[name].shape[1] != dim:
            raise ValueError(f"{name} has {arrays[name].shape[1]} dimensions, {spec.id} has {dim}")
    tolerance = 1e-6 * (spec.action_high - spec.action_low)
    below = arrays["action"] < spec.action_low - tolerance
    if (below | (arrays["action"] > spec.action_high + tolerance)).any():
        raise ValueError(f"action leaves the bounds {spec.action_low} to {spec.action_high}")
