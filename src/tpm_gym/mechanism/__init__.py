"""The robot as data: bodies, joints, closures, and the files other tools read."""
