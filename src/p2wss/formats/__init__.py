"""Buildings in the formats of other programs: CityJSON, GLB, OBJ, PLY, STL, GeoPackage; one format per module."""
