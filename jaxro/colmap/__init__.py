"""COLMAP databases: cameras, matches, and the geometries of their pairs."""
