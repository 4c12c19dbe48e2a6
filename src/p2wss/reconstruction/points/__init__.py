"""Points of buildings: where they are on disk, whose they are, of which class, and whether they can be."""
