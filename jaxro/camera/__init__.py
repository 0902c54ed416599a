"""Cameras: the condition between a place and its ray, and the models of what bends it,
one file each: Brown's lens, a displacement field, zones."""
