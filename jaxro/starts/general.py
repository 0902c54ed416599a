"""The start for photos in any position: candidates from closed forms, chosen by cheirality and residual."""

from .base import AbstractStart, Begin
from .vertical import Vertical
class General(AbstractStart):
    def __call__(self, pair):
        return Vertical()(pair)
