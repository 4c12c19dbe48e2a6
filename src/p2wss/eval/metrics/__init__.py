"""Metrics, one per file, on arrays."""
