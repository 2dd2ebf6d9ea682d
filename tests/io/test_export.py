"""What is exported is read without this library, and computes the same."""

import functools
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import Settings, envs, networks
from cmedirl_jax.io import export
from cmedirl_jax.io.export import Function
from cmedirl_jax.irl.rewards import RewardNetworkSettings
from cmedirl_jax.networks import Architecture
from cmedirl_jax.training import compose
from cmedirl_jax.training.methods import METHODS

SPEC = envs.make("MountainCarContinuous-v0").spec
SETTINGS = {
    "deep": Settings(),
    "state": Settings(reward_network=RewardNetworkSettings(inputs="state")),
    "radial-basis": Settings(reward_network=RewardNetworkSettings("radial-basis", centres=4)),
    "fourier": Settings(reward_network=RewardNetworkSettings("fourier")),
    "batch": Settings(
        architecture=Architecture(actor_normalisation="batch", normalise_observation="statistics")
    ),
    "layer": Settings(architecture=Architecture(actor_normalisation="layer")),
}


def moved(params):
    """Parameters that are no longer those of a start, where all outputs are small."""
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda x: np.asarray(x) + rng.normal(0.0, 0.1, x.shape).astype("f"), params)


@functools.cache
def drawn_actor(architecture):
    return jax.jit(networks.make(SPEC, architecture).actor.init)(jax.random.key(0))


@functools.cache
def functions(method, settings):
    made = compose.compose(SPEC, METHODS[method], settings, 10)
    state = made.learner.init(jax.random.key(0))
    inputs = {"observation": SPEC.observation_dim, "action": SPEC.action_dim}
    return {
        "reward": Function(
            lambda params, *pair: made.learner.reward(state.replace(params=params), *pair),
            # A random reward is standardised as it starts.
            state.params if method == "random-reward" else moved(state.params),
            inputs,
        ),
        "policy": Function(
            lambda params, observation: networks.policy(made.agent.networks, params, observation),
            moved(drawn_actor(settings.architecture)),
            {"observation": SPEC.observation_dim},
        ),
    }


def pairs(*leading):
    rng = np.random.default_rng(0)
    observation = rng.uniform(SPEC.observation_low, SPEC.observation_high, (*leading, 2))
    return observation.astype(np.float32), rng.uniform(-1, 1, (*leading, 1)).astype(np.float32)


def defined(folder, name):
    """The function of a file of Python."""
    scope = {}
    exec((folder / f"{name}.py").read_text(), scope)
    return scope[name]


CASES = [("me-ddpg", name) for name in SETTINGS]
CASES += [(method, "deep") for method in ("gail", "random-reward", "tabular-me-ddpg")]


@pytest.mark.parametrize(("method", "settings"), CASES)
def test_all_forms_compute_the_same(method, settings, tmp_path):
    made = functions(method, SETTINGS[settings])
    export.save(tmp_path / "carried", made, {"task": SPEC.id})
    exported = export.load(tmp_path / "carried")
    for name, each in made.items():
        inputs = pairs(3, 5)[: len(each.inputs)]
        expected = each.function(each.params, *inputs)
        assert np.ptp(expected) > 1e-3
        of_numpy = defined(tmp_path / "carried", name)(*inputs)
        assert of_numpy.dtype == np.float32
        np.testing.assert_allclose(of_numpy, expected, atol=1e-6)
        np.testing.assert_allclose(exported.functions[name](*inputs), expected, atol=1e-6)


def test_a_single_pair_and_the_parameters(tmp_path):
    made = functions("me-ddpg", Settings())
    export.save(tmp_path / "carried", made, {"task": SPEC.id, "seed": 3}, "# Words\n")
    exported = export.load(tmp_path / "carried")
    expected = made["reward"].function(made["reward"].params, *pairs())
    assert expected.shape == ()
    for reward in (defined(tmp_path / "carried", "reward"), exported.functions["reward"]):
        np.testing.assert_allclose(reward(*pairs()), expected, atol=1e-6)
    assert exported.card == {"task": SPEC.id, "seed": 3}
    assert (tmp_path / "carried" / "README.md").read_text() == "# Words\n"
    kernel = made["policy"].params["params"]["Dense_1"]["kernel"]
    np.testing.assert_array_equal(exported.params["policy/params/Dense_1/kernel"], kernel)
    assert exported.functions["reward"](*pairs(0)).shape == (0,)


def test_arrays_in_any_order_of_memory_are_saved_as_they_are(tmp_path):
    matrix = np.asfortranarray(np.arange(6.0, dtype=np.float32).reshape(3, 2))
    times = Function(lambda params, x: x @ params, matrix, {"x": 3})
    export.save(tmp_path / "carried", {"times": times}, {})
    np.testing.assert_array_equal(export.load(tmp_path / "carried").params["times"], matrix)


def test_other_programs_read_it_without_this_library(tmp_path):
    made = functions("me-ddpg", Settings())
    export.save(tmp_path / "carried", made, {})
    expected = made["reward"].function(made["reward"].params, *pairs(4)).tolist()
    script = f"""
import json, sys
for name in ("cmedirl_jax", "flax", "optax", "orbax", "safetensors"): sys.modules[name] = None
import numpy as np
sys.path.insert(0, {str(tmp_path / "carried")!r})
observation, action = (np.array(x, np.float32) for x in json.loads(sys.stdin.read()))
from reward import reward
assert "jax" not in sys.modules
from jax import export
exported = export.deserialize(bytearray(open(sys.path[0] + "/reward.jax", "rb").read()))
assert exported.platforms == ("cpu", "cuda")
print(reward(observation, action).tolist())
print(exported.call(observation, action).tolist())
"""
    given = json.dumps([x.tolist() for x in pairs(4)])
    done = subprocess.run(
        [sys.executable, "-c", script], input=given, capture_output=True, text=True, check=True
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 2
    for line in lines:
        np.testing.assert_allclose(json.loads(line), expected, atol=1e-6)


def test_what_cannot_be_saved_or_loaded_is_refused(tmp_path):
    made = functions("me-ddpg", Settings())
    with pytest.raises(FileNotFoundError, match="nothing that was exported"):
        export.load(tmp_path)
    # Nothing is left of what failed.
    sort = Function(lambda params, x: jnp.sort(x, axis=-1), jnp.zeros(1), {"x": 3})
    with pytest.raises(ValueError, match="numpy's file has no sort"):
        export.save(tmp_path / "carried", {"sorted": sort}, {})
    with pytest.raises(ValueError, match="JSON"):
        export.save(tmp_path / "carried", made, {"return": float("nan")})
    assert list(tmp_path.iterdir()) == []
    export.save(tmp_path / "carried", made, {})
    with pytest.raises(FileExistsError, match="exists"):
        export.save(tmp_path / "carried", made, {})
    for name in ("params.safetensors", "reward.jax", "card.json"):
        path = tmp_path / "carried" / name
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(ValueError, match="damaged"):
            export.load(tmp_path / "carried")
        path.write_bytes(whole)
