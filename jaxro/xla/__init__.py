"""The seam to the compiler: what makes the same numbers sooner."""
