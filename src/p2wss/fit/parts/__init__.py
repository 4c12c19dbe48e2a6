"""Which parts a building has, and what a part costs."""
