"""What is to be done with the robot: scenes, goals, observations, rewards, experts."""
