"""The folder of a run: its tables, checkpoints and demonstrations."""
