"""What moves the robot: state, randomisation, the simulation and its engines."""
