"""The attributes of each building, and the output files."""
