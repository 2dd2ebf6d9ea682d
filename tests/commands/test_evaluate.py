"""A learned policy on the task's fixed starts."""

from cmedirl_jax.commands.cmedirl import main


def test_evaluate_gives_the_return_on_the_tasks_fixed_starts(untrained_run, capsys):
    command = ["evaluate", str(untrained_run), "--method", "ddpg", "--seed", "0", "--starts", "3"]
    assert main(command) == 0
    output = capsys.readouterr().out
    assert "over 3 starts; 999 steps; the task ended 0% of the episodes" in output
