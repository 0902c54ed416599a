"""Heights over a grid of squares from parallaxes, and the networks they form."""
