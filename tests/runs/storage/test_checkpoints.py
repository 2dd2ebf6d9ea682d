import errno
import gc
import hashlib
import os
import resource
import shutil
import types
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cmedirl_jax.io import checkpoint
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.errors import Interrupted, UserError
from cmedirl_jax.runs.storage import checkpoints, sealing
from cmedirl_jax.runs.storage.checkpoints import Checkpointer


class State(NamedTuple):
    parameters: dict
    count: np.ndarray
    reward: None


def state_at(step):
    return State(
        {"weights": np.full((3, 2), step, np.float32)}, np.array([step, 7], np.int32), None
    )


def record_at(step):
    # Empty arrays too, which orbax does not take.
    return {"rows": np.arange(step % 3), "flags": np.array([True, False])}


def like(record):
    del record
    return jax.eval_shape(lambda: jax.tree.map(jnp.asarray, state_at(0)))


def assert_is(found, step):
    assert found.step == step
    for actual, expected in ((found.state, state_at(step)), (found.record, record_at(step))):
        assert jax.tree.structure(actual) == jax.tree.structure(expected)
        for x, y in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(x, y)
            assert x.dtype == y.dtype


class Kept(NamedTuple):
    """A folder of checkpoints, and what was said of it."""

    folder: object
    lines: list
    interruption: Interruption

    def checkpointer(self, *, every=0.0, **identity):
        return Checkpointer(
            self.folder,
            {"jax": "1.0", **identity},
            every=every,
            interruption=self.interruption,
            say=self.lines.append,
        )

    def save(self, *steps, **identity):
        checkpointer = self.checkpointer(**identity)
        for step in steps:
            checkpointer.save_if_due(step, lambda step=step: (state_at(step), record_at(step)))
        checkpointer.wait()

    def names(self):
        return sorted(path.name for path in self.folder.iterdir())


@pytest.fixture
def kept(tmp_path):
    return Kept(tmp_path / "cell", [], Interruption())


def test_the_newest_checkpoint_is_loaded_as_it_was_saved(kept):
    kept.save(250, 500)
    assert_is(kept.checkpointer().load(like), 500)
    assert kept.lines == ["cell goes on from its checkpoint at step 500"]


def test_without_a_checkpoint_there_is_nothing_to_load(kept):
    assert kept.checkpointer().load(like) is None
    kept.folder.mkdir()
    (kept.folder / "note").touch()
    assert kept.checkpointer().load(like) is None


def test_the_last_two_are_kept(kept):
    kept.save(900, 1000, 10_000)
    assert kept.names() == ["1000", "10000"]


def test_a_cell_that_is_finished_keeps_none(kept):
    checkpointer = kept.checkpointer()
    checkpointer.save_if_due(5, lambda: (state_at(5), record_at(5)))
    checkpointer.remove()
    assert not kept.folder.exists()


def test_nothing_is_saved_before_its_time(kept, monkeypatch):
    clock = types.SimpleNamespace(now=0.0)
    monkeypatch.setattr(checkpoints, "time", types.SimpleNamespace(monotonic=lambda: clock.now))
    checkpointer = kept.checkpointer(every=60.0)
    clock.now = 59.0
    checkpointer.save_if_due(1, lambda: pytest.fail("too early"))
    clock.now = 61.0
    checkpointer.save_if_due(2, lambda: (state_at(2), record_at(2)))
    clock.now = 120.0
    checkpointer.save_if_due(3, lambda: pytest.fail("too early again"))
    checkpointer.wait()
    assert kept.names() == ["2"]


def test_a_signal_is_obeyed_once_all_is_saved(kept):
    checkpointer = kept.checkpointer(every=1e6)
    kept.interruption.signal = 15
    with pytest.raises(Interrupted):
        checkpointer.save_if_due(4, lambda: (state_at(4), record_at(4)))
    assert_is(kept.checkpointer().load(like), 4)


def test_checkpoints_are_saved_one_at_a_time_and_in_order(kept):
    checkpointer = kept.checkpointer()
    for step in range(20):
        checkpointer.save_if_due(step, lambda step=step: (state_at(step), record_at(step)))
    checkpointer.wait()
    assert kept.names() == ["18", "19"]
    assert_is(kept.checkpointer().load(like), 19)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    kept = Kept(tmp_path_factory.mktemp("checkpoints") / "cell", [], Interruption())
    kept.save(250, 500)
    return kept.folder


def files_of(folder):
    return sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())


@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_a_damaged_checkpoint_is_reported_and_the_one_before_is_loaded(saved, tmp_path, data):
    shutil.rmtree(tmp_path / "cell", ignore_errors=True)
    shutil.copytree(saved, tmp_path / "cell")
    kept = Kept(tmp_path / "cell", [], Interruption())
    path = kept.folder / "500" / data.draw(st.sampled_from(files_of(saved / "500")))
    content = bytearray(path.read_bytes())
    match data.draw(st.sampled_from(["cut", "flipped", "gone", "longer"])):
        case "cut" if content:
            path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
        case "flipped" if content:
            for _ in range(data.draw(st.integers(1, 3))):
                bit = data.draw(st.integers(0, 8 * len(content) - 1))
                content[bit // 8] ^= 1 << bit % 8
            if bytes(content) == path.read_bytes():
                return
            path.write_bytes(content)
        case "gone":
            path.unlink()
        case _:
            path.write_bytes(content + b"x")
    found = kept.checkpointer().load(like)
    if found.step == 500:
        # Only where the seal still says the same: a changed blank between its values.
        assert path.name == "seal.json"
        return
    assert_is(found, 250)
    line, _ = kept.lines
    assert line.startswith(f"{kept.folder / '500'} is damaged (")
    assert kept.names() == ["250"]


def test_where_all_are_damaged_training_begins_anew(kept):
    kept.save(250, 500)
    for step in ("250", "500"):
        (kept.folder / step / "record.npz").write_bytes(b"")
    assert kept.checkpointer().load(like) is None
    assert len(kept.lines) == 2
    assert not kept.names()


def test_a_checkpoint_cut_off_while_it_was_written_is_not_seen(kept, monkeypatch):
    kept.save(250)

    def cut_off(path, tree):
        path.mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint, "save", cut_off)
    checkpointer = kept.checkpointer()
    checkpointer.save_if_due(500, lambda: (state_at(500), record_at(500)))
    with pytest.raises(KeyboardInterrupt):
        checkpointer.wait()
    assert_is(kept.checkpointer().load(like), 250)


def test_what_an_earlier_process_left_unfinished_is_in_nobodys_way(kept):
    (kept.folder / ".125.partial" / "state").mkdir(parents=True)
    kept.save(250)
    assert kept.names() == ["250"]


@pytest.mark.parametrize(
    ("identity", "line"),
    [
        ({"jax": "2.0"}, "was written with jax 1.0, this is 2.0;"),
        ({"numpy": "2"}, "was written with numpy None, this is 2;"),
    ],
)
def test_another_version_is_refused_and_the_checkpoints_stay(kept, identity, line):
    kept.save(250, 500)
    with pytest.raises(UserError, match=line):
        kept.checkpointer(**identity).load(like)
    assert kept.names() == ["250", "500"]


def test_another_structure_begins_anew_and_says_so(kept):
    kept.save(250)
    assert kept.checkpointer().load(lambda record: {"other": jnp.zeros(3)}) is None
    assert "holds another structure" in kept.lines[0]


@pytest.mark.parametrize("schema", [2, 4])
def test_another_schema_is_refused_and_kept(kept, monkeypatch, schema):
    monkeypatch.setattr(sealing, "SCHEMA", schema)
    kept.save(250)
    monkeypatch.undo()
    with pytest.raises(UserError, match=f"has schema {schema}, this version reads 3"):
        kept.checkpointer().load(like)
    assert kept.names() == ["250"]


def test_a_checkpoint_that_was_renamed_is_not_of_its_step(kept):
    kept.save(250, 500)
    (kept.folder / "500").rename(kept.folder / "1500")
    assert_is(kept.checkpointer().load(like), 250)
    assert kept.lines[0].startswith(f"{kept.folder / '1500'} is damaged (it is of step 500)")


UNREADABLE = {
    "folder": (os, "scandir"),
    "seal": (Path, "read_bytes"),
    "folder of the state": (os, "walk"),
    "files": (hashlib, "file_digest"),
    "record": (np, "load"),
    "state": (checkpoint, "load"),
}


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES, errno.EMFILE, errno.ESTALE])
@pytest.mark.parametrize("what", UNREADABLE)
def test_a_checkpoint_that_cannot_be_read_for_now_is_refused_and_kept(
    kept, monkeypatch, what, number
):
    kept.save(250, 500)

    def fail(*_, **__):
        raise OSError(number, os.strerror(number), "the file")

    with monkeypatch.context() as patch:
        patch.setattr(*UNREADABLE[what], fail)
        with pytest.raises(UserError) as refused:
            kept.checkpointer().load(like)
    line = f"--out: cannot use the file ({os.strerror(number)}); the checkpoints are kept"
    assert str(refused.value) == line
    assert kept.names() == ["250", "500"]
    assert_is(kept.checkpointer().load(like), 500)


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is closed to this user")
def test_a_folder_that_is_closed_to_the_user_is_not_damaged(kept):
    kept.save(250)
    state = kept.folder / "250" / "state"
    state.chmod(0)
    try:
        with pytest.raises(UserError, match="Permission denied"):
            kept.checkpointer().load(like)
    finally:
        state.chmod(0o700)
    assert kept.names() == ["250"]


def test_what_is_called_like_a_step_and_is_no_folder_is_left_alone(kept):
    kept.save(250, 500)
    (kept.folder / "99999").touch()
    (kept.folder / "88888").symlink_to(kept.folder / "250")
    assert_is(kept.checkpointer().load(like), 500)
    kept.save(750, 88888, 99999)
    assert kept.names() == ["500", "750", "88888", "99999"]
    assert_is(kept.checkpointer().load(like), 750)
    reports = [line for line in kept.lines if line.startswith("no checkpoint could be saved")]
    assert len(reports) == 2


def test_a_full_disk_is_reported_and_training_goes_on(kept, monkeypatch):
    kept.save(250)
    usage = shutil.disk_usage(kept.folder)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=10))
    checkpointer = kept.checkpointer()
    checkpointer.save_if_due(500, lambda: (state_at(500), record_at(500)))
    checkpointer.wait()
    assert kept.lines == [
        f"no checkpoint could be saved in {kept.folder} (No space left on device)"
    ]
    monkeypatch.undo()
    checkpointer.save_if_due(750, lambda: (state_at(750), record_at(750)))
    checkpointer.wait()
    assert kept.names() == ["250", "750"]


# Orbax abandons its other writes, and the collector complains of them.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_write_that_fails_under_orbaxs_hands_is_reported_and_training_goes_on(kept):
    kept.save(250)
    large = {"weights": np.random.default_rng(0).random(2**18)}
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    checkpointer = kept.checkpointer()
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, before[1]))
    try:
        checkpointer.save_if_due(500, lambda: (large, {}))
        checkpointer.wait()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        gc.collect()
    assert kept.lines == [f"no checkpoint could be saved in {kept.folder} (File too large)"]
    assert kept.names() == ["250"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("state", [{"weights": object()}, {"weights": np.zeros(0)}])
def test_what_can_never_be_saved_is_an_error(kept, state):
    checkpointer = kept.checkpointer()
    checkpointer.save_if_due(250, lambda: (state, {}))
    with pytest.raises((AttributeError, ValueError)):
        checkpointer.wait()
    gc.collect()
