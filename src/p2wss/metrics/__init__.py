"""Metrics on arrays, one per file. Pure: they know no stage, no file and no configuration."""
