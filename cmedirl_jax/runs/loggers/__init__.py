"""Logs of a run's evaluations, written while it trains."""
