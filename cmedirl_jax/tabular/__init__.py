"""Maximum-entropy IRL and control with a model, by dynamic programming (Eqs. 1 and 4-9)."""

from cmedirl_jax.tabular import discretise, imitation, interpolation, table_reward
from cmedirl_jax.tabular.demonstrations import (
    Steps,
    TabularDemonstrations,
    empirical_visitation,
)
from cmedirl_jax.tabular.dynamics import SparseDynamics
from cmedirl_jax.tabular.fixed_point import Stop
from cmedirl_jax.tabular.interpolation import Grid
from cmedirl_jax.tabular.maxent import (
    MaxEntInfo,
    MaxEntResult,
    deep_maxent_irl,
    maxent_irl,
)
from cmedirl_jax.tabular.optimal_control import OptimalPolicy, value_iteration
from cmedirl_jax.tabular.soft_control import SoftPolicy, expected_visitation, soft_value_iteration

__all__ = [
    "Grid",
    "MaxEntInfo",
    "MaxEntResult",
    "OptimalPolicy",
    "SoftPolicy",
    "SparseDynamics",
    "Steps",
    "Stop",
    "TabularDemonstrations",
    "deep_maxent_irl",
    "discretise",
    "empirical_visitation",
    "expected_visitation",
    "imitation",
    "interpolation",
    "maxent_irl",
    "soft_value_iteration",
    "table_reward",
    "value_iteration",
]
