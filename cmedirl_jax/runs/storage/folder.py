"""The folder of a run: its configuration, its lock, and which files in it are the run's own."""

import contextlib
import hashlib
import importlib.metadata
import json
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import filelock

from cmedirl_jax import envs
from cmedirl_jax.io import atomic
from cmedirl_jax.runs import numerics
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import cells, checkpoints, outputs, sealing
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations

PACKAGES = (
    *("cmedirl-jax", "jax", "jaxlib", "flax", "optax"),
    *("chex", "gymnasium", "numpy", "orbax-checkpoint"),
)
LOG = "log"
"""`log/CELL` holds what all loggers write of a cell."""
REWARD = "reward"
"""What `cmedirl reward` says of the rewards."""
FOLDERS = (
    *(stored_demonstrations.FOLDER, checkpoints.FOLDER, cells.FOLDER),
    *("figures", LOG, REWARD),
)
FILES = (
    *("config.json", "summary.csv", "claims.md", "report.html"),
    *(f"{name}.parquet" for name in cells.TABLES),
)
CELLS_ASKED = ("methods", "n_demos", "seeds")
"""The options that say which cells there are. The same folder may be given others."""
_LOCK = ".lock"
NOT_COMPARED = (
    *("out", "grid", "devices", "distributed", "coordinator", "processes", "process_id"),
    *("checkpoint_every", "check_demos", "demos_format", "demos_actions", "asynchronous"),
    *("log", "log_seeds", "seeds_at_once"),
    *CELLS_ASKED,
)
"""The options that runs of one configuration may differ in."""


def check(folder: Path, config: dict[str, Any]) -> None:
    """Check that a run can use its folder, which may not be there yet; writes nothing.

    Args:
        folder: the run's.
        config: its configuration as JSON values.

    Raises:
        UserError: if it cannot be written, holds another configuration's run, one that was begun
            with other `numerics`, or other files.
    """
    path = folder / "config.json"
    if not str(folder).isprintable():
        raise UserError(f"--out: {str(folder)!r} cannot be printed; give a plainer name")
    try:
        if path.exists():
            _compare(folder, config)
        elif folder.is_dir():
            _check_nothing_else_in(folder)
        for name in FOLDERS:
            if (folder / name).exists() and not (folder / name).is_dir():
                raise UserError(f"--out: {folder / name} is in the way; a folder belongs there")
        atomic.check_writable(folder)
    except OSError as error:
        raise UserError(f"--out: cannot write to {folder} ({error.strerror})") from error


def _check_nothing_else_in(folder: Path) -> None:
    # A process that was killed before it had written its configuration may have been here.
    own = {_LOCK, atomic.partial(folder / "config.json").name}
    for path in sorted(folder.iterdir()):
        if path.name not in own:
            raise UserError(
                f"--out: {folder} holds {path.name} and no config.json of a run; choose another "
                "folder, which a run has to itself"
            )


@contextlib.contextmanager
def opened(folder: Path, config: dict[str, Any]) -> Iterator[list[cells.SavedCell]]:
    """Hold the run's folder against other processes; gives its finished cells.

    The folder and its config.json are made where they are missing. A run that has saved nothing of
    its training has not begun: its config.json is replaced. A `UserError` before the first cell is
    finished leaves nothing new in the folder.

    Raises:
        UserError: as `check`, if another process holds the folder, or a cell is damaged.
    """
    check(folder, config)
    made = [path for path in (folder, *folder.absolute().parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out: cannot write to {folder} ({error.strerror})") from error
    before = set(folder.iterdir())
    with held(folder):
        try:
            # Once more: another process may have been here since.
            check(folder, config)
            with naming_the_option():
                finished = cells.finished(folder)
            _remove_unfinished(folder)
            if not ((folder / "config.json").exists() and _begun(folder)):
                _remove([folder / stored_demonstrations.FOLDER])
                began = {"versions": versions(), "numerics": numerics.current()}
                _write(folder, {"schema": sealing.SCHEMA, "config": config, **began})
            yield finished
        except UserError:
            if not cells.any_begun(folder):
                _remove({folder / name for name in (*FOLDERS, *FILES, _LOCK)} - before)
                # Files that somebody else put there meanwhile stay, and so does their folder.
                with contextlib.suppress(OSError):
                    for path in made:
                        path.rmdir()
            raise


@contextlib.contextmanager
def held(folder: Path) -> Iterator[None]:
    """Lock a folder. The operating system unlocks it when the process ends, however that ends.

    Raises:
        UserError: if another process holds it.
    """
    lock = filelock.FileLock(folder / _LOCK)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout as error:
        raise UserError(f"--out: another process is at work in {folder}") from error
    except OSError as error:
        raise UserError(f"--out: cannot lock {folder / _LOCK} ({error.strerror})") from error
    try:
        yield
    finally:
        lock.release()


@contextlib.contextmanager
def naming_the_option() -> Iterator[None]:
    """Put the option that names the folder before what is wrong in it."""
    try:
        yield
    except UserError as error:
        raise UserError(f"--out: {error}") from error


def _remove_unfinished(folder: Path) -> None:
    """Remove what a process that was killed while writing left behind."""
    _remove(atomic.partial(folder / name) for name in (*FILES, stored_demonstrations.FOLDER))
    for name in (cells.FOLDER, "figures"):
        _remove((folder / name).glob(atomic.partial(Path("*")).name))


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def remove_checkpoints(folder: Path, names: Iterable[str]) -> None:
    """Remove the checkpoints of finished cells; others stay for the run that will need them."""
    for name in names:
        shutil.rmtree(folder / checkpoints.FOLDER / name, ignore_errors=True)
    with contextlib.suppress(OSError):
        (folder / checkpoints.FOLDER).rmdir()


def note_cells_asked(folder: Path, config: dict[str, Any]) -> None:
    """Write to config.json which cells `config` asks for: those that the run's tables show."""
    written = read(folder)
    now = written["config"] | {name: config[name] for name in CELLS_ASKED}
    _write(folder, written | {"config": now})


def note_scale(folder: Path, scale: dict[str, Any]) -> None:
    """Write to config.json where the task's returns lie, see `cells.scale.Scale`."""
    _write(folder, read(folder) | {"scale": scale})


def solved(folder: Path, written: dict[str, Any]) -> float:
    """The return that counts as solved in a run.

    Args:
        folder: the run's.
        written: its config.json.

    Raises:
        UserError: if the task has no threshold and the run's scale is not known.
    """
    scale, config = written.get("scale"), written["config"]
    try:
        found = envs.find(config["env"]).spec.reward_threshold if scale is None else scale["solved"]
        if found is not None:
            return float(found)
    except (LookupError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise UserError(
            f"{folder / 'config.json'} is not a readable configuration ({reason})"
        ) from error
    raise UserError(f"{folder}: its task has no threshold, and its experts are not trained yet")


def _begun(folder: Path) -> bool:
    """Whether something is saved that was trained by config.json; a copy of --demos was not."""
    copied = read(folder)["config"].get("demos") is not None
    return (
        cells.any_begun(folder)
        or any(folder.glob(f"{checkpoints.FOLDER}/*/*/{sealing.SEAL}"))
        or ((folder / stored_demonstrations.FOLDER).exists() and not copied)
    )


def _write(folder: Path, content: dict[str, Any]) -> None:
    outputs.write(folder / "config.json", (json.dumps(content, indent=2) + "\n").encode())


def read(folder: Path) -> dict[str, Any]:
    """The content of a run's config.json: `config`, `versions`, `numerics`, and its `scale`.

    Raises:
        UserError: if there is none, or it is damaged or of another version.
    """
    path = folder / "config.json"
    try:
        written = json.loads(path.read_text())
        schema = written["schema"]
        # A run of before they were noted has no numerics.
        parts = (written["config"], written["versions"], written.setdefault("numerics", {}))
        if not all(isinstance(part, dict) for part in parts):
            raise TypeError("config, versions or numerics is no object")
    except FileNotFoundError as error:
        raise UserError(f"{folder}: holds no run (there is no config.json)") from error
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{path} is not a readable configuration ({reason})") from error
    if schema != sealing.SCHEMA:
        raise UserError(
            f"{path} has schema {schema!r}, this version writes {sealing.SCHEMA}: another "
            "version began the run; finish it with that one, or choose another folder"
        )
    return written


def versions() -> dict[str, str]:
    """The versions of the packages that a run's numbers depend on."""
    return {name: importlib.metadata.version(name) for name in PACKAGES}


def other_versions(folder: Path) -> dict[str, str]:
    """The versions that began the run, of packages which have another one now."""
    began, now = read(folder)["versions"], versions()
    return {name: version for name, version in began.items() if now.get(name) != version}


def identity(config: dict[str, Any]) -> dict[str, Any]:
    """JSON values that a checkpoint shares with a run that continues it."""
    compared = {name: value for name, value in flat(config).items() if name not in NOT_COMPARED}
    digest = hashlib.sha256(json.dumps(compared, sort_keys=True).encode()).hexdigest()
    return {"config": digest, **versions(), **numerics.current()}


def _compare(folder: Path, config: dict[str, Any]) -> None:
    with naming_the_option():
        written = read(folder)
    if not _begun(folder):
        return
    began = written["numerics"]
    for name, value in numerics.current().items():
        if began.get(name, value) != value:
            raise UserError(
                f"--out: {folder} holds a run begun with {name}={began[name]!r}, this is "
                f"{value!r}; choose another folder or the same setting"
            )
    before, now = flat(written["config"]), flat(config)
    for name in sorted(before.keys() | now.keys()):
        if name not in NOT_COMPARED and before.get(name) != now.get(name):
            raise UserError(
                f"--out: {folder} holds a run with {_option(name)} {before.get(name)}, not "
                f"{now.get(name)}; choose another folder or the same configuration"
            )


def flat(nested: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A configuration's values by the names of their options."""
    values = {}
    for name, value in nested.items():
        if isinstance(value, dict):
            # The learners' settings are options of the command's first level.
            values |= flat(value, "" if f"{prefix}{name}" == "settings" else f"{prefix}{name}.")
        else:
            values[prefix + name] = value
    return values


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
