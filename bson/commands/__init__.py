"""The parts of the command `bson`: each adds commands, and runs them."""
