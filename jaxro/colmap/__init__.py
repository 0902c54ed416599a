"""COLMAP databases: cameras, matches, and the geometries of their pairs."""

try:
    import pycolmap as pycolmap
except ModuleNotFoundError:
    raise SystemExit(
        "COLMAP databases need pycolmap: pip install 'jaxro[cli,colmap]'"
    ) from None
