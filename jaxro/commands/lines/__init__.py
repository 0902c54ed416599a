"""The command line of each command: its options, and the call that they make."""
