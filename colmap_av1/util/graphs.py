"""Graphs of images or keypoints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def connected_components(num_nodes: int, edges: NDArray[np.integer]) -> NDArray[np.int32]:
    """Number the components of an undirected graph.

    Args:
        num_nodes: number of nodes.
        edges: integers [m, 2], the nodes that each edge joins, from 0.

    Returns:
        int32 [num_nodes] number of each node's component, from 0 without gaps.
    """
    from scipy.sparse import coo_array, csgraph  # noqa: PLC0415 - slow to import

    ends = (edges[:, 0], edges[:, 1])
    graph = coo_array((np.ones(len(edges), np.int8), ends), shape=(num_nodes, num_nodes))
    return np.asarray(csgraph.connected_components(graph, directed=False)[1], dtype=np.int32)
