"""What JAX was told, by its options or the environment, that changes numbers beyond rounding."""

import os

import jax

OPTIONS = (
    # Other random numbers.
    *("jax_default_prng_impl", "jax_threefry_partitionable", "jax_random_seed_offset"),
    # Other precision than float32's.
    *("jax_enable_x64", "jax_default_matmul_precision"),
)
ENVIRONMENT = ("NVIDIA_TF32_OVERRIDE",)


def current() -> dict[str, bool | int | str | None]:
    """The options and variables by name, and the platform, as JSON values.

    Left out is what only rounds otherwise: XLA's flags, and the number of devices under the usual
    generator. Under others a seed draws what depends on the seeds that are stepped together.
    """
    options = {name: getattr(jax.config, name) for name in OPTIONS}
    usual = options["jax_default_prng_impl"] == "threefry2x32"
    return {
        **options,
        **{name: os.environ.get(name) for name in ENVIRONMENT},
        # Matrix products of GPUs have fewer bits by default, and "rbg" draws other numbers there.
        "platform": jax.default_backend(),
        "devices": None if usual else jax.device_count(),
    }
