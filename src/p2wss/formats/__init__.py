"""Buildings as files that other programs read: CityJSON text sequences, GLB, GeoPackage."""
