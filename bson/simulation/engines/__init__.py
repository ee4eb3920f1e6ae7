"""Physics engines of the robot's worlds, one a file."""
