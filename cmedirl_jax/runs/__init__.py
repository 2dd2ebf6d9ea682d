"""Runs of many seeds that are never lost: configuration, cells, results on disk."""
