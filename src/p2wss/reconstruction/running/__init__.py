"""Running many buildings: in several processes, going on after failures, with results on disk."""
