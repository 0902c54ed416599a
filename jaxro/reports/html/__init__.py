"""Reports as pages of a browser: one file that needs nothing else."""
