"""One stereo pair: what was measured, and how the photos lie."""
