"""`python -m benchmarks.irl_peers`: our IRL beside that of other libraries, on one core.

With a model: as many gradient steps on the same gridworlds, from the same demonstrations, in double
precision; what they have learned is compared, then they are timed in turn. Without: GAIL on the
same agent, task and demonstrations, for as many steps.
"""

import contextlib
import dataclasses
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import platformdirs
import tyro
from rich import box
from rich.table import Table

from benchmarks import gridworlds, measuring, peers
from benchmarks.serving import Worker
from benchmarks.worker import demonstrations
from cmedirl_jax.data import demonstrations as demonstrations_lib
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.storage import outputs

HORIZON = 50
"""Steps of an episode that does not end by itself."""
GRADIENT_STEPS = 20
DEMONSTRATIONS = 20
"""Of the car, for GAIL."""
FORMS = ("dense", "sparse")
"""Of the dynamics, in our library."""
IMITATION = ("torch", "imitation==1.0.1")


class ModelPeer(NamedTuple):
    """Maximum-entropy IRL with a model, of another library.

    Attributes:
        name: in the table.
        module: of `benchmarks.peer_loops`.
        environment: name of its virtual environment.
        requirements: what pip installs there.
        ends: whether its episodes end in the last cell, or after `HORIZON` steps.
    """

    name: str
    module: str
    environment: str
    requirements: tuple[str, ...]
    ends: bool


MODEL_PEERS = (
    ModelPeer("imitation MCEIRL", "imitation_mce", "imitation", IMITATION, ends=False),
    ModelPeer(
        "irl-maxent irl_causal",
        "irl_maxent_causal",
        "irl_maxent",
        ("irl-maxent==0.1.0",),
        ends=True,
    ),
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What to compare, and where to write it.

    Attributes:
        sides: Cells along each side of the gridworlds.
        rounds: How often each is timed.
        gail_seeds: Agents of each library that GAIL trains; 0: none.
        gail_steps: Environment steps of each.
        environments: Folder of the peers' virtual environments.
        json: File for the measurements.
    """

    sides: tuple[int, ...] = (4, 8, 16, 32)
    rounds: int = 7
    gail_seeds: int = 8
    gail_steps: tuple[int, ...] = (2_000, 12_000)
    environments: Path = platformdirs.user_cache_path("cmedirl_jax", appauthor=False) / "peers"
    json: Path | None = None


@ending.in_a_line("irl_peers")
def main(options: Options) -> int:
    """Install, measure, print and write; returns the exit code."""
    outputs.check("json", options.json)
    console = screen.console()
    result: dict[str, Any] = {**measuring.heading("irl_peers"), "with_model": [], "gail": []}

    def write() -> None:
        if options.json is not None:
            measuring.write(result, options.json)

    with tempfile.TemporaryDirectory() as folder:
        for peer in MODEL_PEERS:
            for side in options.sides:
                console.print(f"{peer.name}: {side * side} states")
                result["with_model"].append(with_model(peer, side, options, Path(folder)))
                write()
        if options.gail_seeds:
            for steps in options.gail_steps:
                console.print(f"GAIL: {options.gail_seeds} seeds of {steps} steps")
                result["gail"].append(gail(steps, options, Path(folder)))
                write()
    screen.show(console, model_table(result["with_model"]))
    for entry in result["gail"]:
        console.print(gail_line(entry), highlight=False)
    return 0


def with_model(peer: ModelPeer, side: int, options: Options, folder: Path) -> dict[str, Any]:
    """One gridworld: differences of what is learned, rates in gradient steps a second, ratios."""
    states = side * side
    horizon = 20 * side if peer.ends else HORIZON
    path = folder / f"{peer.module}-{side}.npz"
    problem = gridworlds.make(side, horizon, ends=peer.ends)
    np.savez(path, **problem._asdict())
    entry: dict[str, Any] = {"peer": peer.name, "states": states, "steps": GRADIENT_STEPS}
    with contextlib.ExitStack() as running:
        try:
            theirs = _peer(peer, path, GRADIENT_STEPS, options, running, entry)
        except (RuntimeError, OSError, subprocess.CalledProcessError) as error:
            return {**entry, "error": str(error)}
        ours = {form: _ours("irl_ours", path, form, running) for form in FORMS}

        # What was learned.
        for form, worker in ours.items():
            entry[f"difference_{form}"] = _difference(theirs.facts, worker.facts)
        if "as_it_is" in theirs.facts:
            entry["difference_as_it_is"] = _difference(
                theirs.facts["as_it_is"], ours["dense"].facts
            )

        # How fast.
        workers = [(worker, GRADIENT_STEPS, GRADIENT_STEPS) for worker in (theirs, *ours.values())]
        their_rates, *our_rates = measuring.in_turn(workers, options.rounds)
    entry["peer_steps_per_second"] = statistics.median(their_rates)
    for form, rates in zip(FORMS, our_rates, strict=True):
        ratio = measuring.compare("irl_peers", f"ours, {form} / {peer.name}", rates, their_rates)
        entry[f"{form}_steps_per_second"] = statistics.median(rates)
        entry[f"{form}_ratio"] = dataclasses.asdict(ratio)
    return entry


def gail(steps: int, options: Options, folder: Path) -> dict[str, Any]:
    """Returns of r_e after so many steps, and environment steps a second, of both libraries."""
    path = folder / "demonstrations.npz"
    demonstrations_lib.save(path, demonstrations(DEMONSTRATIONS))
    seeds = options.gail_seeds
    entry: dict[str, Any] = {"steps": steps, "seeds": seeds}
    peer = ModelPeer("imitation GAIL", "imitation_gail", "imitation", IMITATION, ends=False)
    with contextlib.ExitStack() as running:
        try:
            # A short first call: each trains an agent from the start.
            theirs = _peer(peer, path, 400, options, running, entry)
        except (RuntimeError, OSError, subprocess.CalledProcessError) as error:
            return {**entry, "error": str(error)}
        many, one = (_ours("gail_ours", path, str(count), running, steps) for count in (seeds, 1))
        answers = {"ours": [many.ask(steps)], "ours_one_seed": [one.ask(steps)]}
        answers["peer"] = [theirs.ask(steps) for _ in range(seeds)]
    for name, given in answers.items():
        returns = [value for answer in given for value in answer["returns"]]
        rate = len(returns) * steps / sum(answer["seconds"] for answer in given)
        entry[name] = {"returns": returns, "env_steps_per_second": rate}
    return entry


def _peer(
    peer: ModelPeer,
    path: Path,
    steps: int,
    options: Options,
    running: contextlib.ExitStack,
    entry: dict[str, Any],
) -> Worker:
    """The process of a peer's loop, its first call done; `running` stops it at the end."""
    python = peers.environment(peer.environment, peer.requirements, options.environments)
    entry["versions"] = peers.versions(python)
    module = f"benchmarks.peer_loops.{peer.module}"
    return _started([str(python), "-m", module, str(path), str(steps)], running)


def _ours(
    module: str,
    path: Path,
    option: str,
    running: contextlib.ExitStack,
    steps: int = GRADIENT_STEPS,
) -> Worker:
    """The process of one of our loops, likewise."""
    command = [sys.executable, "-m", f"benchmarks.{module}", str(path), option, str(steps)]
    return _started(command, running)


def _started(command: list[str], running: contextlib.ExitStack) -> Worker:
    worker = Worker(command, measuring.one_core())
    running.callback(worker.stop)
    worker.wait()
    return worker


def _difference(theirs: dict[str, Any], ours: dict[str, Any]) -> dict[str, float]:
    """Of visits `[S]`, the largest one, and of the log likelihoods."""
    visits = np.abs(np.subtract(theirs["visitation"], ours["visitation"])).max()
    likelihood = abs(theirs["log_likelihood"] - ours["log_likelihood"])
    return {"visitation": float(visits), "log_likelihood": float(likelihood)}


def model_table(entries: list[dict[str, Any]]) -> Table:
    """A row for each gridworld of each peer."""
    shown = Table(box=box.SIMPLE, title="gradient steps per second on one core, medians")
    names = ("states", "difference", "theirs", "ours, dense", "ours, sparse", "ratio, dense")
    shown.add_column("peer")
    for name in names:
        shown.add_column(name, justify="right")
    for entry in entries:
        start = (entry["peer"], f"{entry['states']:,}")
        if "error" in entry:
            shown.add_row(*start, "not installed", *[""] * 3, entry["error"])
            continue
        difference = max(entry[f"difference_{form}"]["visitation"] for form in FORMS)
        ratio = entry["dense_ratio"]
        shown.add_row(
            *(*start, f"{difference:.1e}", f"{entry['peer_steps_per_second']:,.1f}"),
            *(f"{entry[f'{form}_steps_per_second']:,.1f}" for form in FORMS),
            f"{ratio['median']:.1f} ({ratio['low']:.1f} to {ratio['high']:.1f})",
        )
    return shown


def gail_line(entry: dict[str, Any]) -> str:
    """A line about one length of training."""
    start = f"GAIL, {entry['steps']:,} steps: "
    if "error" in entry:
        return f"{start}not installed: {entry['error']}"
    parts = []
    for name, words in (("ours", "ours"), ("peer", "imitation's"), ("ours_one_seed", "our one")):
        found = entry[name]
        mean, deviation = np.mean(found["returns"]), np.std(found["returns"])
        rate = found["env_steps_per_second"]
        parts.append(f"{words} {mean:.1f} (sd {deviation:.1f}) at {rate:,.0f} steps/s")
    return start + ", ".join(parts)


if __name__ == "__main__":
    options = tyro.cli(Options, prog="python -m benchmarks.irl_peers", description=__doc__)
    sys.exit(main(options))
