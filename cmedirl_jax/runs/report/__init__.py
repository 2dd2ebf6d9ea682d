"""The report of a run: its summary, figures and page, made from its cells."""
