import hashlib

import numpy as np
import pytest

from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from tests.support import pools

ENV = pools.ENV


@pytest.fixture
def folder(tmp_path):
    stored_demonstrations.save(tmp_path, pools.scripted(3))
    return tmp_path


def test_the_pool_comes_back_with_the_digest_that_others_would_take(folder):
    pool = stored_demonstrations.load(folder, ENV)
    np.testing.assert_array_equal(pool.transition.action, pools.scripted(3).transition.action)
    digest, name = (folder / "demonstrations" / "pool.npz.sha256").read_text().split()
    assert name == "pool.npz"
    content = (folder / "demonstrations" / "pool.npz").read_bytes()
    assert digest == hashlib.sha256(content).hexdigest()


def test_another_valid_pool_in_its_place_is_refused(folder):
    demonstrations.save(folder / "demonstrations" / "pool.npz", pools.scripted(4))
    with pytest.raises(UserError, match=r"^--out: .*pool\.npz is not what this run kept"):
        stored_demonstrations.load(folder, ENV)


@pytest.mark.parametrize("missing", ["pool.npz", "pool.npz.sha256"])
def test_a_pool_that_was_not_kept_to_the_end_is_made_again(folder, missing):
    (folder / "demonstrations" / missing).unlink()
    assert stored_demonstrations.load(folder, ENV) is None


@pytest.mark.parametrize("content", [b"", b"\xff", b"\n", b"0" * 64 + b"  pool.npz\n"])
def test_a_damaged_digest_is_refused(folder, content):
    (folder / "demonstrations" / "pool.npz.sha256").write_bytes(content)
    with pytest.raises(UserError, match="is not what this run kept"):
        stored_demonstrations.load(folder, ENV)
