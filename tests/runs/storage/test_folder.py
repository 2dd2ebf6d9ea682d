import dataclasses
import json
import math
from pathlib import Path

import jax
import pytest
from hypothesis import given, settings

from cmedirl_jax.irl import IRLHParams
from cmedirl_jax.runs import validation
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import cells, sealing
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage.cells import CellKey
from cmedirl_jax.training.settings import Settings
from experiments.presets import PRESETS
from tests.support import cells as cells_of
from tests.support import damages, kills


@pytest.fixture
def config(tmp_path):
    return StudyConfig(out=tmp_path / "run")


def contents(folder):
    """Every file below `folder`, with its bytes."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def opening(config):
    return run_folder.opened(config.folder, validation.describe(config))


def opened(config):
    """Enter the run's folder and leave it; returns the folder."""
    with opening(config):
        return config.folder


def begun(config, saved="checkpoint"):
    """A run's folder in which training has saved something; returns the folder."""
    folder = opened(config)
    if saved == "cell":
        cells_of.save(folder, CellKey(0, "none", "ddpg", 0, 0, 2))
    elif saved == "checkpoint":
        write(folder, ("checkpoints/experts/250/seal.json",))
    else:
        write(folder, ("demonstrations/pool.npz",))
    return folder


def write(folder, names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)


def test_configuration_is_strict_json_with_versions(tmp_path):
    settings = dataclasses.replace(
        PRESETS["paper"].settings, reward=IRLHParams(gauge_rate=math.inf)
    )
    config = dataclasses.replace(PRESETS["paper"], out=tmp_path, settings=settings)
    text = (opened(config) / "config.json").read_text()
    written = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert written["schema"] == sealing.SCHEMA
    assert written["versions"]["jax"] == jax.__version__
    assert written["config"]["n_demos"] == [200]
    assert written["config"]["settings"]["reward"]["gauge_rate"] == "inf"
    assert written["config"]["settings"]["hot_start"]["critic"] == "softmax"


@pytest.mark.parametrize("preset", PRESETS)
def test_the_same_configuration_enters_again_and_changes_nothing(preset, tmp_path):
    config = dataclasses.replace(PRESETS[preset], out=tmp_path)
    opened(config)
    before = contents(tmp_path)
    assert opened(config) == tmp_path
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 3}, "--seed 0, not 3;"),
        ({"expert": "all"}, "--expert each, not all;"),
        ({"max_steps": None, "max_episodes": 5}, "--max-episodes None, not 5;"),
        ({"demos": Path(__file__)}, f"--demos None, not {__file__};"),
        (
            {"settings": Settings(reward=IRLHParams(weight_limit=5.0))},
            "--reward.weight-limit None, not 5.0;",
        ),
    ],
)
def test_another_configuration_is_refused_naming_the_option_and_both_values(config, change, named):
    folder = begun(config)
    before = contents(folder)
    with pytest.raises(UserError) as error:
        opened(dataclasses.replace(config, **change))
    assert str(error.value).startswith("--out: ")
    assert named in str(error.value)
    assert "\n" not in str(error.value)
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("mode", "named"),
    [
        (jax.default_prng_impl("rbg"), "jax_default_prng_impl='threefry2x32', this is 'rbg';"),
        (jax.threefry_partitionable(False), "jax_threefry_partitionable=True, this is False;"),
        (jax.enable_x64(True), "jax_enable_x64=False, this is True;"),
        (
            jax.default_matmul_precision("bfloat16"),
            "jax_default_matmul_precision=None, this is 'bfloat16';",
        ),
    ],
)
def test_a_run_that_was_begun_with_other_settings_of_jax_is_refused(config, mode, named):
    folder = begun(config)
    before = contents(folder)
    described = validation.describe(config)
    identity = run_folder.identity(described)
    with mode:
        with pytest.raises(UserError) as error:
            opened(config)
        assert run_folder.identity(described) != identity
    assert str(error.value).startswith(f"--out: {folder} holds a run begun with {named}")
    assert "\n" not in str(error.value)
    assert contents(folder) == before


def test_a_run_that_was_begun_elsewhere_is_refused(config, monkeypatch):
    begun(config)
    monkeypatch.setenv("NVIDIA_TF32_OVERRIDE", "1")
    with pytest.raises(UserError, match="NVIDIA_TF32_OVERRIDE=None, this is '1'"):
        opened(config)
    monkeypatch.undo()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.raises(UserError, match="platform='cpu', this is 'gpu'"):
        opened(config)


def test_the_number_of_devices_is_part_of_a_run_where_seeds_draw_together(config, monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 2)
    with jax.default_prng_impl("rbg"):
        begun(config)
        monkeypatch.setattr(jax, "device_count", lambda: 1)
        with pytest.raises(UserError, match="begun with devices=2, this is 1"):
            opened(config)


def test_a_run_of_before_these_settings_were_noted_goes_on(config):
    path = begun(config) / "config.json"
    written = json.loads(path.read_text())
    del written["numerics"]
    path.write_text(json.dumps(written))
    with jax.enable_x64(True):
        assert opened(config) == config.folder


def test_what_is_asked_of_the_demonstrations_may_differ(config):
    folder = begun(config)
    assert opened(dataclasses.replace(config, check_demos="spec")) == folder


@pytest.mark.parametrize("saved", ["cell", "checkpoint", "demonstrations"])
def test_what_training_has_saved_keeps_its_configuration(config, saved):
    folder = begun(config, saved)
    before = contents(folder)
    with pytest.raises(UserError, match="holds a run with --seed 0, not 3"):
        opened(dataclasses.replace(config, seed=3))
    assert contents(folder) == before


def test_a_start_that_crashed_refuses_no_other_options(config):
    copied = dataclasses.replace(config, demos=Path(__file__), seed=1)
    folder = opened(copied)
    write(folder, ("demonstrations/pool.npz", "checkpoints/ddpg-seeds-0-9/.250.partial/state"))
    opened(config)
    assert run_folder.read(folder)["config"] == validation.describe(config)
    # The copy of other --demos is gone: the experts' demonstrations are missing, and made.
    assert not (folder / "demonstrations").exists()


def test_a_crashed_start_leaves_no_versions_to_later_ones(config, monkeypatch):
    monkeypatch.setattr(run_folder, "versions", lambda: {"jax": "0.1"})
    folder = opened(config)
    monkeypatch.undo()
    opened(config)
    assert run_folder.other_versions(folder) == {}


def test_a_start_killed_at_any_moment_hinders_no_other(tmp_path):
    def start(folder, seed):
        with run_folder.opened(folder / "run", {"seed": seed, "demos": "pool.npz"}):
            write(folder / "run", ("demonstrations/pool.npz",))

    def seed(folder):
        return run_folder.read(folder / "run")["config"]["seed"]

    kills.check_replaces(start, seed, 1, 2, tmp_path)


def test_methods_numbers_and_seeds_may_differ_and_are_noted_once_the_tables_show_them(config):
    folder = begun(config)
    before = contents(folder)
    more = dataclasses.replace(config, methods=("ddpg", "bc"), n_demos=(1, 10), seeds=3)
    opened(more)
    assert contents(folder) == before
    run_folder.note_cells_asked(folder, validation.describe(more))
    noted = run_folder.read(folder)
    assert noted["config"] == validation.describe(more)
    assert noted["versions"] == run_folder.versions()
    assert opened(config) == folder


def test_what_checkpoints_share_does_not_depend_on_the_cells_asked_for(config):
    def identity(**changes):
        return run_folder.identity(validation.describe(dataclasses.replace(config, **changes)))

    assert identity(methods=("bc",), n_demos=(1,), seeds=3, checkpoint_every=1.0) == identity()
    assert identity(check_demos="none") == identity()
    assert identity(seed=1) != identity()
    assert identity()["jax"] == jax.__version__


def test_the_folders_spelling_and_the_devices_are_not_compared(config, monkeypatch):
    folder = opened(config)
    monkeypatch.chdir(folder.parent)
    respelled = dataclasses.replace(config, out=Path(folder.name), devices=2)
    assert opened(respelled).samefile(folder)


@pytest.mark.parametrize(
    "damaged",
    [
        b"",
        b"{",
        b"\xff",
        b"[]",
        b"[" * 100_000,
        b'{"config": {}}',
        b'{"schema": 3}',
        b'{"schema": 3, "config": []}',
        b'{"schema": 3, "config": {}}',
        b'{"schema": 4, "config": {}, "versions": {}}',
        b'{"schema": 3, "config": {}, "versions": []}',
        b'{"schema": 3, "config": {}, "versions": {}, "numerics": []}',
    ],
)
def test_a_damaged_or_newer_configuration_is_refused_and_kept(config, damaged):
    path = opened(config) / "config.json"
    path.write_bytes(damaged)
    with pytest.raises(UserError, match=r"^--out: .*config\.json"):
        opened(config)
    assert path.read_bytes() == damaged


def test_a_run_begun_by_an_earlier_version_is_refused_in_a_line_that_says_so(config):
    path = opened(config) / "config.json"
    path.write_text(path.read_text().replace('"schema": 3', '"schema": 1'))
    (config.folder / "tables.json").touch()
    with pytest.raises(UserError) as error:
        opened(config)
    assert str(error.value) == (
        f"--out: {path} has schema 1, this version writes 3: another version began the run; finish "
        "it with that one, or choose another folder"
    )


@pytest.mark.parametrize("below", ["file", "file/run", "file/deep/run"])
def test_a_folder_that_cannot_be_made_is_refused(tmp_path, below):
    file = tmp_path / "file"
    file.write_text("kept")
    with pytest.raises(UserError, match=r"^--out: cannot write to "):
        opened(StudyConfig(out=tmp_path / below))
    assert contents(tmp_path) == {file: b"kept"}


def test_a_folder_that_holds_something_else_is_refused_and_left_alone(config):
    (config.folder / "checkpoints").mkdir(parents=True)
    (config.folder / "checkpoints" / "model.bin").write_bytes(b"somebody's")
    before = contents(config.folder)
    with pytest.raises(UserError, match=r"^--out: .* holds checkpoints and no config\.json"):
        opened(config)
    assert contents(config.folder) == before


def test_a_folder_whose_run_was_killed_at_once_is_taken(config):
    config.folder.mkdir()
    (config.folder / ".lock").touch()
    (config.folder / ".config.json.partial").write_text("{")
    assert {path.name for path in opened(config).iterdir()} == {".lock", "config.json"}


UNFINISHED = (
    *(".seeds.parquet.partial", ".demonstrations.partial/pool.npz.partial"),
    *("cells/.ddpg-seeds-0-99.partial/policies/file", "figures/.figure3.png.partial"),
)
SOMEBODYS = (".notes.partial", "downloads/film.partial", "cells/mine", "notes.txt")


def test_what_a_killed_run_left_is_removed_and_nothing_else(config):
    opened(config)
    write(config.folder, (*UNFINISHED, *SOMEBODYS))
    opened(config)
    found = {str(path.relative_to(config.folder)) for path in contents(config.folder)}
    assert found == {".lock", "config.json", *SOMEBODYS}


def refused_at_work(config, names):
    with opening(config):
        write(config.folder, names)
        raise UserError("no expert")


@pytest.mark.parametrize("out", ["run", "deep/run", "a/../run"])
def test_a_refusal_at_work_removes_what_is_the_runs_own(tmp_path, out):
    with pytest.raises(UserError, match="no expert"):
        refused_at_work(
            StudyConfig(out=tmp_path / out), ("checkpoints/1", "demonstrations/pool.npz")
        )
    assert not any(tmp_path.iterdir())


def test_a_refusal_at_work_leaves_what_somebody_else_put_there(config):
    with pytest.raises(UserError, match="no expert"):
        refused_at_work(config, ("checkpoints/1", "notes.txt"))
    assert {path.name for path in contents(config.folder)} == {"notes.txt"}


def test_a_refusal_at_work_keeps_the_cells_that_are_finished(config):
    opened(config)
    cells_of.save(config.folder, CellKey(0, "none", "ddpg", 0, 0, 2))
    with pytest.raises(UserError, match="no expert"):
        refused_at_work(config, ("demonstrations/pool.npz",))
    assert len(cells.finished(config.folder)) == 1
    assert (config.folder / "demonstrations" / "pool.npz").exists()


def test_a_damaged_cell_is_refused_before_anything_is_removed(config):
    opened(config)
    path = cells_of.save(config.folder, CellKey(0, "none", "ddpg", 0, 0, 2))
    (path / "seeds.parquet").unlink()
    write(config.folder, UNFINISHED)
    before = contents(config.folder)
    with pytest.raises(UserError, match=r"is damaged \(seeds\.parquet\)"):
        opened(config)
    assert contents(config.folder) == before


def test_checkpoints_of_finished_cells_go_and_others_stay(config):
    folder = opened(config)
    write(folder, ("checkpoints/ddpg-seeds-0-1/250/file", "checkpoints/bc-n5-seeds-0-1/250/file"))
    run_folder.remove_checkpoints(folder, ["ddpg-seeds-0-1"])
    assert [path.name for path in (folder / "checkpoints").iterdir()] == ["bc-n5-seeds-0-1"]
    run_folder.remove_checkpoints(folder, ["bc-n5-seeds-0-1"])
    assert not (folder / "checkpoints").exists()


@pytest.mark.parametrize("name", run_folder.FOLDERS)
def test_a_file_where_a_folder_belongs_is_refused(config, name):
    opened(config)
    (config.folder / name).touch()
    with pytest.raises(UserError, match=f"^--out: .*{name} is in the way"):
        opened(config)


@pytest.mark.parametrize("name", ["two\nlines", "not\udcffutf-8"])
def test_a_name_that_cannot_be_printed_is_refused(tmp_path, name):
    with pytest.raises(UserError, match=r"^--out: .* cannot be printed") as error:
        opened(StudyConfig(out=tmp_path / name))
    assert str(error.value).isprintable()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run's folder, and its configuration."""
    config = StudyConfig(out=tmp_path_factory.mktemp("whole"))
    opened(config)
    return config


@settings(max_examples=100)
@given(damage=damages.damages())
def test_a_damaged_configuration_is_a_users_error_or_harmless(whole, damage):
    with damages.done_to(whole.folder / "config.json", damage):
        described = validation.describe(whole)
        _, refusal = damages.attempt(UserError, run_folder.check, whole.folder, described)
    assert refusal is None or refusal.startswith("--out: ")
    assert "\n" not in str(refusal)
