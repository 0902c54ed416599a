"""What `jaxro NAME` does, one file a command."""
