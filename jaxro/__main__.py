"""`python -m jaxro`"""

from .cli import app

app(prog_name="jaxro")
