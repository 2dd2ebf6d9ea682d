import hashlib
import json

import numpy as np
import pytest

from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from tests.support import pools


@pytest.fixture
def folder(tmp_path):
    stored_demonstrations.save(tmp_path, pools.scripted(3))
    return tmp_path / "demonstrations"


def test_the_pool_comes_back_with_the_digest_that_others_would_take(folder):
    pool = stored_demonstrations.load(folder.parent)
    np.testing.assert_array_equal(pool.transition.action, pools.scripted(3).transition.action)
    digests = json.loads((folder / "seal.json").read_text())["files"]
    content = (folder / "pool.npz").read_bytes()
    assert digests == {"pool.npz": hashlib.sha256(content).hexdigest()}


def test_a_run_that_keeps_none_yet_has_none(tmp_path):
    assert stored_demonstrations.load(tmp_path) is None


def test_another_valid_pool_in_its_place_is_refused(folder):
    demonstrations.save(folder / "pool.npz", pools.scripted(4))
    with pytest.raises(UserError, match=r"^.*demonstrations is damaged \(pool\.npz\)"):
        stored_demonstrations.load(folder.parent)


@pytest.mark.parametrize("missing", ["pool.npz", "seal.json"])
def test_a_pool_of_which_a_file_is_gone_is_refused(folder, missing):
    (folder / missing).unlink()
    with pytest.raises(UserError, match=rf"is damaged \({missing}\)"):
        stored_demonstrations.load(folder.parent)


@pytest.mark.parametrize("content", [b"", b"\xff", b"\n", b"{}"])
def test_a_damaged_seal_is_refused(folder, content):
    (folder / "seal.json").write_bytes(content)
    with pytest.raises(UserError, match=r"is damaged \(seal\.json\)"):
        stored_demonstrations.load(folder.parent)


def test_a_pool_that_was_not_held_to_the_task_comes_back(tmp_path):
    stored_demonstrations.save(tmp_path, pools.scripted(3)._replace(metadata={"env": "Other-v1"}))
    pool = stored_demonstrations.load(tmp_path)
    assert pool.metadata == {"env": "Other-v1"}
