"""Tables that the command line works on when it is given none."""
