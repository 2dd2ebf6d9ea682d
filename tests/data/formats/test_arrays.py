"""Archives of arrays: no pickle in them is read."""

import numpy as np
import pytest

from cmedirl_jax.data import demonstrations
from tests.support.formats import SPEC, as_imitation, assert_steps, episodes


def test_no_pickle_is_ever_loaded(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (print, ("it was loaded",))

    trajectories = episodes()
    path = as_imitation(trajectories, tmp_path / "pool")
    with np.load(path, allow_pickle=True) as file:
        arrays = dict(file)
    arrays["infos"] = np.array([Bomb()] * 8)
    np.savez(path, **arrays)
    assert_steps(demonstrations.read(path, env=SPEC), trajectories)
    arrays["rews"] = np.array([Bomb()] * 8, dtype=object)
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=r"read as imitation, it is damaged .*pickled objects"):
        demonstrations.read(path, env=SPEC)


def test_a_file_that_may_not_be_read_is_not_called_damaged(monkeypatch, tmp_path):
    h5py = pytest.importorskip("h5py")

    def refuse(*arguments, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(h5py, "File", refuse)
    (tmp_path / "closed.hdf5").touch()
    with pytest.raises(PermissionError, match="Permission denied"):
        demonstrations.read(tmp_path / "closed.hdf5", format="d4rl-file")
