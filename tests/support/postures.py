"""Postures as the viewer has drawn them."""

import numpy as np
from viser.transforms import SO3

from tpm_gym.viewer.viewer import Viewer


def drawn_gap(viewer: Viewer) -> float:
    """Return the largest distance between both ends of a closure of the links in the scene, m."""
    assert viewer.worker.wait()  # a posture is set before its links are drawn
    nodes, mechanism = viewer.robot.links, viewer.explore.posture.machine.mechanism

    def place(link, point):
        node = nodes[link]
        return node.position + SO3(node.wxyz).as_matrix() @ point

    gaps = [
        place(closure.link_a, closure.point_a) - place(closure.link_b, closure.point_b)
        for closure in mechanism.closures
    ]
    return float(np.linalg.norm(gaps, axis=1).max())
