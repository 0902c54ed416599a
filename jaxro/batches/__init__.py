"""Many pairs of every length at once."""
