"""STUB."""

import numpy as np


class Pucks:
    def __init__(self, block, count, step, table):
        self.block, self.n = block, count
        self.p = np.zeros((3, count))

    def alter(self, rows, m, f):
        pass

    def place(self, rows, positions):
        self.p[:, rows] = positions.T

    def advance(self, rows, path, on):
        return np.zeros((path.shape[0] - 2, 3, path.shape[2]))

    def report(self):
        n = self.n
        k = 1 if self.block else 0
        return dict(
            object_position=np.ascontiguousarray(self.p.T)[:, None][:, :k],
            object_quaternion=np.tile([0, 0, 0, 1.0], (n, k, 1)),
            object_axis=np.tile([0, 0, 1.0], (n, k, 1)),
            object_velocity=np.zeros((n, k, 3)),
            object_angular_velocity=np.zeros((n, k, 3)),
            held=np.full(n, -1),
            vacuum=np.zeros(n),
        )

    def save(self, rows):
        return self.p[:, rows].copy()

    def restore(self, rows, data):
        self.p[:, rows] = data
