"""Texts and bytes of files with a few places changed, the same ones in every run."""

import random


def mutants(text, pieces, count, seed=0):
    """So many texts (or bytes) with one place changed, or with up to four, by one of
    the pieces."""
    rng = random.Random(seed)
    for _ in range(count):
        changed = text
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            at = rng.randrange(len(changed) + 1)
            end = min(len(changed), at + rng.choice((0, 0, 1, 3, 20)))
            changed = changed[:at] + rng.choice(pieces) + changed[end:]
        yield changed
