"""Learn rewards from demonstrations. `cmedirl COMMAND --help` says more of each command."""

import dataclasses
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from cmedirl_jax import ranges
from cmedirl_jax.commands import convert, evaluate, inspect, record, reward, template, train, watch
from cmedirl_jax.runs.console import ending
from cmedirl_jax.runs.errors import UserError

Demos = (
    Annotated[inspect.Options, tyro.conf.subcommand("inspect", description=inspect.__doc__)]
    | Annotated[convert.Options, tyro.conf.subcommand("convert", description=convert.__doc__)]
    | Annotated[record.Options, tyro.conf.subcommand("record", description=record.__doc__)]
    | Annotated[template.Options, tyro.conf.subcommand("template", description=template.__doc__)]
)


@dataclasses.dataclass(frozen=True)
class DemosOptions:
    """Demonstrations: look at them, convert them, record some, or begin with a template."""

    what: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Demos]]


_RUNS = {
    inspect.Options: inspect.run,
    convert.Options: convert.run,
    record.Options: record.run,
    template.Options: template.run,
    evaluate.Options: evaluate.run,
    watch.Options: watch.run,
    reward.Options: reward.run,
}


@ending.in_a_line("cmedirl")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    # A task of the user's own, MODULE:NAME, may lie in the current folder, as with `python -m`.
    sys.path.insert(0, os.getcwd())
    chosen = tyro.cli(
        _commands(arguments),
        prog="cmedirl",
        description=__doc__,
        args=arguments,
    )
    if isinstance(chosen, train.Options):
        # A run checks its own numbers, whose ranges may depend on each other.
        return train.run(chosen, arguments)
    options = chosen.what if isinstance(chosen, DemosOptions) else chosen
    for name, wrong in ranges.out_of_range(options):
        raise UserError(f"--{name.replace('_', '-')}: {wrong}")
    return _RUNS[type(options)](options)


def _commands(arguments: Sequence[str]) -> Any:
    """The union of the commands' options; some defaults depend on the arguments."""
    # The task's module is imported for its settings: for no other command.
    default = train.default(arguments) if arguments[:1] == ["train"] else train.Options()
    of_train = tyro.conf.subcommand("train", default=default, description=train.__doc__)
    of_evaluate = tyro.conf.subcommand("evaluate", description=evaluate.__doc__)
    of_reward = tyro.conf.subcommand("reward", description=reward.__doc__)
    of_watch = tyro.conf.subcommand("watch", description=watch.__doc__)
    return (
        Annotated[train.Options, of_train]
        | Annotated[evaluate.Options, of_evaluate]
        | Annotated[watch.Options, of_watch]
        | Annotated[reward.Options, of_reward]
        | Annotated[DemosOptions, tyro.conf.subcommand("demos")]
    )
