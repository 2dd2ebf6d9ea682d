import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.runs.cluster.base import ALONE, ClusterOptions
from cmedirl_jax.runs.errors import UserError
from tests.support import ROOT, pools


def test_one_process_has_nothing_to_exchange():
    pool = pools.scripted(2)
    value = {"cells": [["ddpg", 0]], "seed": 1}
    assert ALONE.writer
    assert ALONE.from_writer(lambda: value) is value
    assert ALONE.pool_from_writer(lambda: pool) is pool
    assert ALONE.pool_from_writer(lambda: None) is None
    assert ALONE.call(max, 1, 2) == 2
    assert ALONE.any(True)
    assert not ALONE.any(False)
    assert ALONE.devices(1, 100) == jax.local_devices()[:1]
    assert ALONE.devices(None, 1) == jax.local_devices()
    np.testing.assert_array_equal(ALONE.arrays_from_writer([np.arange(3)]), [[0, 1, 2]])
    gathered = ALONE.gather({"weights": jnp.ones(2), "none": None})
    assert isinstance(gathered["weights"], np.ndarray)
    ALONE.check_same({"seeds": 3})


def test_what_is_refused_is_raised():
    def refuse():
        raise UserError("--out: no")

    with pytest.raises(UserError, match="--out: no"):
        ALONE.from_writer(refuse)


def test_several_processes_are_those_of_a_cluster_or_of_a_coordinator():
    assert not ClusterOptions().several
    assert ClusterOptions(distributed=True).several
    assert ClusterOptions(coordinator="host:1", processes=1, process_id=0).several


def test_nothing_outside_knows_of_several_processes():
    """Of the run's code, `runs/cluster/` alone asks JAX which process it is."""
    words = ("jax.distributed", "process_count", "process_index")
    for folder in ("cmedirl_jax/runs", "experiments"):
        for path in (ROOT / folder).rglob("*.py"):
            if path.parent.name != "cluster":
                assert not any(word in path.read_text() for word in words), path


def test_orbax_is_called_in_a_process_of_its_own():
    script = "from cmedirl_jax.runs.cluster import orbax_worker as w; import os\n"
    script += "if __name__ == '__main__': print(w.call(os.getpid) != os.getpid())"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout == "True\n", done.stderr
