"""Assessment of an oriented pair: what its result is worth."""
