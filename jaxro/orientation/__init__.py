"""Relative orientation of one pair, and what its result says of itself."""
