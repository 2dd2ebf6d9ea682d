"""`python -m benchmarks.peers`: our rate beside that of other libraries, on one core.

Each peer gets an environment of its own, made at its first use and kept in the user's cache folder.
All loops use the same networks, batch and replay and take one update per environment step; they are
timed in turn. What is not the same work is printed with the numbers.
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

STEPS = 500
"""Environment steps per learner and round."""


class Peer(NamedTuple):
    """Another library's training loop.

    Attributes:
        name: as the table has it.
        module: of `benchmarks.peer_loops`.
        requirements: what pip installs into its environment.
        seeds: learners that it trains at once.
        difference: what is not the same work.
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
        peers: Which peers.
        rounds: How often each is timed.
        environments: Folder of the peers' environments.
        json: File for the measurements.
    """

    peers: tuple[str, ...] = tuple(peer.module for peer in PEERS)
    rounds: int = 7
    environments: Path = platformdirs.user_cache_path("cmedirl_jax", appauthor=False) / "peers"
    json: Path | None = None


def environment(name: str, requirements: Sequence[str], folder: Path) -> Path:
    """The Python of the environment `name` below `folder`, made if it does not hold all of it.

    Raises:
        RuntimeError: if something cannot be installed, with the end of what the installer said.
    """
    root = folder / name
    python = root / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    ready = root / "requirements.txt"
    wanted = "\n".join(requirements)
    if ready.exists() and ready.read_text() == wanted:
        return python
    subprocess.run([sys.executable, "-m", "venv", "--clear", root], check=True)
    installed = subprocess.run(
        [python, "-m", "pip", "install", "--quiet", *requirements],
        capture_output=True,
        text=True,
        check=False,
    )
    if installed.returncode:
        raise RuntimeError(installed.stderr.strip()[-500:])
    ready.write_text(wanted)
    return python


def versions(python: Path) -> dict[str, str]:
    """What is installed beside a peer."""
    listed = subprocess.run(
        [python, "-m", "pip", "list", "--format", "json"],
        capture_output=True,
        text=True,
        check=True,
    )
    return {package["name"]: package["version"] for package in json.loads(listed.stdout)}


def main(options: Options) -> int:
    """Install, measure, print and write."""
    console = Console(width=None if sys.stdout.isatty() else 140)
    ours = Workload()
    entries: list[dict[str, Any]] = [
        peer._asdict() for peer in PEERS if peer.module in options.peers
    ]
    with contextlib.ExitStack() as running:
        our_worker = measuring.start(ours, STEPS)
        running.callback(our_worker.stop)
        workers = [(our_worker, STEPS, float(ours.seeds * STEPS))]
        for entry in entries:
            console.print(f"{entry['name']}: preparing")
            try:
                python = environment(entry["module"], entry["requirements"], options.environments)
                command = [str(python), "-m", f"benchmarks.peer_loops.{entry['module']}"]
                sizes = [str(entry["seeds"]), str(STEPS)]
                worker = Worker([*command, *sizes], measuring.one_core())
                running.callback(worker.stop)
                worker.wait()
            except (RuntimeError, OSError, subprocess.CalledProcessError) as error:
                entry["error"] = str(error)
                continue
            entry["versions"] = versions(python)
            workers.append((worker, STEPS, float(entry["seeds"] * STEPS)))
        # Some compile again at their second call.
        measuring.in_turn(workers, 1)
        our_rates, *rates = measuring.in_turn(workers, options.rounds)
    measured = (entry for entry in entries if "error" not in entry)
    for entry, peer_rates in zip(measured, rates, strict=True):
        ratio = measuring.compare("peers", f"ours / {entry['name']}", our_rates, peer_rates)
        entry["learning_steps_per_second"] = statistics.median(peer_rates)
        entry["ratio"] = dataclasses.asdict(ratio)
    result = {
        **measuring.heading("peers"),
        "ours": {"seeds": ours.seeds, "learning_steps_per_second": statistics.median(our_rates)},
        "peers": entries,
    }
    console.print(table(result))
    if options.json is not None:
        measuring.write(result, options.json)
    return 0


def table(result: dict[str, Any]) -> Table:
    """The rates, and what is not the same work."""
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
    sys.exit(main(tyro.cli(Options, prog="python -m benchmarks.peers")))
