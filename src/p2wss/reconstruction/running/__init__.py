"""Many buildings in processes, with failures survived and results kept on disk."""
