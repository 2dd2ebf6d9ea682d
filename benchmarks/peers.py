"""`python -m benchmarks.peers`: our rate beside that of other libraries, on one core.

Each peer has a virtual environment of its own, which is made at its first use and kept in the
user's cache folder. All loops have the same sizes of networks, batch and replay and take one update
per environment step. They are timed in turn. Differences in the work are printed with the numbers.
"""

import contextlib
import dataclasses
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import platformdirs
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks import measuring
from benchmarks.serving import Worker
from benchmarks.workload import Workload
from cmedirl_jax.io import atomic
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.storage import outputs

STEPS = 500
"""Environment steps per learner and round."""


class Peer(NamedTuple):
    """Another library's training loop.

    Attributes:
        name: in the table.
        module: of `benchmarks.peer_loops`.
        requirements: what pip installs into its environment.
        seeds: learners that it trains at once.
        difference: how its work differs from ours.
    """

    name: str
    module: str
    requirements: tuple[str, ...]
    seeds: int
    difference: str


PEERS = (
    Peer(
        "stable-baselines3 DDPG",
        "sb3_ddpg",
        ("torch==2.13.0", "stable-baselines3"),
        1,
        "one seed; the environment is Gymnasium's, in Python",
    ),
    Peer(
        "sbx DDPG",
        "sbx_ddpg",
        ("torch==2.13.0", "sbx-rl"),
        1,
        "one seed; the environment is Gymnasium's, in Python",
    ),
    Peer(
        "CleanRL-style JAX loop",
        "cleanrl_style",
        ("jax", "flax", "optax", "gymnasium"),
        1,
        "one seed; the environment is Gymnasium's, in Python; Gaussian noise",
    ),
    Peer(
        "rejax TD3",
        "rejax_td3",
        ("rejax", "gymnax==0.0.9"),
        100,
        "two critics and target noise; swish units; Gaussian noise; gymnax's physics",
    ),
)


@dataclasses.dataclass(frozen=True)
class Options:
    """Whom to compare with, and where to write it.

    Attributes:
        peers: Peers to measure, by their modules in `benchmarks.peer_loops`.
        rounds: How often each is timed.
        environments: Folder of the peers' virtual environments.
        json: File for the measurements.
    """

    peers: tuple[str, ...] = tuple(peer.module for peer in PEERS)
    rounds: int = 7
    environments: Path = platformdirs.user_cache_path("cmedirl_jax", appauthor=False) / "peers"
    json: Path | None = None


def environment(name: str, requirements: Sequence[str], folder: Path) -> Path:
    """The Python of the virtual environment `folder / name`, made anew for other requirements.

    Raises:
        RuntimeError: if something cannot be installed, with the end of the installer's message.
    """
    root = folder / name
    python = root / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    ready = root / "requirements.txt"
    wanted = "\n".join(requirements)
    if ready.exists() and ready.read_text() == wanted:
        return python
    # First, because a process that is killed while it clears the folder may leave the file there.
    ready.unlink(missing_ok=True)
    subprocess.run([sys.executable, "-m", "venv", "--clear", root], check=True)
    installed = subprocess.run(
        [python, "-m", "pip", "install", "--quiet", *requirements],
        capture_output=True,
        text=True,
        check=False,
    )
    if installed.returncode:
        raise RuntimeError(installed.stderr.strip()[-500:])
    with atomic.replacing(ready) as partial:
        partial.write_text(wanted)
    return python


def versions(python: Path) -> dict[str, str]:
    """The versions of the packages in a peer's environment."""
    listed = subprocess.run(
        [python, "-m", "pip", "list", "--format", "json"],
        capture_output=True,
        text=True,
        check=True,
    )
    return {package["name"]: package["version"] for package in json.loads(listed.stdout)}


@ending.in_a_line("peers")
def main(options: Options) -> int:
    """Install, measure, print and write; returns the exit code."""
    outputs.check("json", options.json)
    console = screen.console()
    ours = Workload()
    entries: list[dict[str, Any]] = [
        peer._asdict() for peer in PEERS if peer.module in options.peers
    ]
    our_rates, peer_rates = measure(ours, entries, options, console)
    for entry, rates in zip(entries, peer_rates, strict=True):
        if rates is None:
            continue
        ratio = measuring.compare("peers", f"ours / {entry['name']}", our_rates, rates)
        entry["learning_steps_per_second"] = statistics.median(rates)
        entry["ratio"] = dataclasses.asdict(ratio)
    result = {
        **measuring.heading("peers"),
        "ours": {"seeds": ours.seeds, "learning_steps_per_second": statistics.median(our_rates)},
        "peers": entries,
    }
    if options.json is not None:
        measuring.write(result, options.json)
    screen.show(console, table(result))
    return 0


def measure(
    ours: Workload, entries: list[dict[str, Any]], options: Options, console: Console
) -> tuple[list[float], list[list[float] | None]]:
    """Time our loop and each peer's in turn.

    Returns:
        Our rates, and each entry's; None for one that could not be started. Such an entry gets the
        field "error", the others "versions".
    """
    with contextlib.ExitStack() as running:
        our_worker = measuring.start(ours, STEPS)
        running.callback(our_worker.stop)
        timed = [(our_worker, STEPS, float(ours.seeds * STEPS))]
        for entry in entries:
            console.print(f"{entry['name']}: preparing")
            try:
                worker = start(entry, options.environments, running)
            except (RuntimeError, OSError, subprocess.CalledProcessError) as error:
                entry["error"] = str(error)
                continue
            timed.append((worker, STEPS, float(entry["seeds"] * STEPS)))
        # Some loops compile again at their second call, which is therefore not counted.
        measuring.in_turn(timed, 1)
        our_rates, *rates = measuring.in_turn(timed, options.rounds)
    remaining = iter(rates)
    return our_rates, [None if "error" in entry else next(remaining) for entry in entries]


def start(entry: dict[str, Any], environments: Path, running: contextlib.ExitStack) -> Worker:
    """The process of a peer's loop, its first call done; `running` stops it at the end.

    Raises:
        RuntimeError: if it cannot be installed, or its loop fails.
        OSError: if its environment cannot be made.
        subprocess.CalledProcessError: likewise.
    """
    python = environment(entry["module"], entry["requirements"], environments)
    command = [str(python), "-m", f"benchmarks.peer_loops.{entry['module']}"]
    sizes = [str(entry["seeds"]), str(STEPS)]
    worker = Worker([*command, *sizes], measuring.one_core())
    running.callback(worker.stop)
    worker.wait()
    entry["versions"] = versions(python)
    return worker


def table(result: dict[str, Any]) -> Table:
    """The rates, and how the work differs."""
    shown = Table(box=box.SIMPLE, title="learning steps per second on one core, medians")
    shown.add_column("loop")
    for name in ("seeds", "steps/s", "ours is faster"):
        shown.add_column(name, justify="right")
    shown.add_column("not the same work")
    ours = result["ours"]
    rate = f"{ours['learning_steps_per_second']:,.0f}"
    shown.add_row("cmedirl_jax DDPG", str(ours["seeds"]), rate, "", "")
    for entry in result["peers"]:
        if "error" in entry:
            shown.add_row(entry["name"], str(entry["seeds"]), "not installed", "", entry["error"])
            continue
        shown.add_row(
            entry["name"],
            str(entry["seeds"]),
            f"{entry['learning_steps_per_second']:,.0f}",
            f"{entry['ratio']['median']:.1f}x",
            entry["difference"],
        )
    return shown


if __name__ == "__main__":
    options = tyro.cli(Options, prog="python -m benchmarks.peers", description=__doc__)
    sys.exit(main(options))
