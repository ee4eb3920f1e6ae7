"""The parts of the command `macid`: each adds commands, and runs them."""
