"""Compare a description with its model, and let the robot stand."""
