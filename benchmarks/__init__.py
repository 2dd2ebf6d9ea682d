"""How fast it is, and beside whom: `python -m benchmarks.seeds_per_second`, and the others."""

from experiments import check_command

COMMANDS = (
    "seeds_per_second",
    "peers",
    "irl_peers",
    "irl_ours",
    "gail_ours",
    "profile",
    "main_job",
    "checkpoint_cost",
    "soak",
    "scaling",
    "coverage",
    "gymnasium_tasks",
    "host_tasks",
    "worker",
)

check_command("benchmarks", COMMANDS)
