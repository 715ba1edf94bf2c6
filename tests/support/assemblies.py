"""All assemblies of the mechanism, by a root finder on the closure equations written out."""

import numpy as np
from roots import circle_roots

from tpm_gym.arrays import FloatArray
from tpm_gym.kinematics.geometry import Geometry


def assemblies(
    theta: FloatArray, g: Geometry, modes: tuple[bool, ...] = (False, True)
) -> list[FloatArray]:
    """P, cos and sin of the tilt (k, 5) of all assemblies of each theta.

    ``modes`` says which: with link 3' level (False), or turned (True).

    Seen along y as complex numbers: Sc goes round its foot; Sd, 2 l5 from it and as far from its
    own foot as Sc from its, has two places, each other's mirror images in the line from foot to Sc.
    """
    c, s = g.l3 * np.cos(theta.T), g.l3 * np.sin(theta.T)
    rows = np.flatnonzero(np.abs(g.l1 + c[0]) <= g.l4)
    c, s = c[:, rows], s[:, rows]
    rod, b2 = np.sqrt(g.l4**2 - (g.l1 + c[0]) ** 2), c[1] - g.l1 + 1j * s[1]
    b3 = c[2] + g.l1 + 1j * s[2]
    found: list[list[FloatArray]] = [[] for _ in theta]
    for crossed in modes:

        def balls(row, turn, crossed=crossed):
            foot = -g.l5 + 1j * s[0][row]
            sc = foot + 2 * g.l5 + rod[row] * np.exp(1j * turn)
            line = (sc - foot) / abs(sc - foot)
            return sc, foot + line**2 * np.conj(sc - 2 * g.l5 - foot) if crossed else sc - 2 * g.l5

        def loop1(row, turn, balls=balls):
            sc, sd = balls(row, turn)
            return np.asarray(abs(sc + 1.5 * (sd - sc) - b2[row]) ** 2 - g.l4**2)

        row, turn = circle_roots(loop1, len(rows))
        sc, sd = balls(row, turn)
        along, c1 = (sc - sd) / (2 * g.l5), (sc + sd) / 2

        def on_platform(i, beta, x, z, c1 = c1,
                        along = along):  # fmt: skip
            return c1[i] + along[i] * (g.l7 * np.cos(beta) + x + 1j * z)

        def loop2(i, beta, row=row, place=on_platform):
            apart = place(i, beta, 2 * g.l2, g.l6) - b3[row][i]
            return abs(apart) ** 2 + (g.l7 * np.sin(beta)) ** 2 - g.l4**2

        i, beta = circle_roots(loop2, len(row))
        p = on_platform(i, beta, g.l2, 2 * g.l6)
        columns = p.real, g.l7 * np.sin(beta), p.imag, along[i].real, -along[i].imag
        for at, solution in zip(rows[row[i]], np.stack(columns, axis=-1), strict=True):
            found[at].append(solution)
    return [np.array(some).reshape(-1, 5) for some in found]
