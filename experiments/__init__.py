"""The paper's study, as a command: `python -m experiments.run_grid`."""
