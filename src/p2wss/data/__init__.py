"""What the stages share: buildings, points, footprints, terrain, tiles and their files."""
