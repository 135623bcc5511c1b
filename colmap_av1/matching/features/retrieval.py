"""Retrieve similar images, with a vocabulary trained on the video itself.

Vectors of locally aggregated descriptors (Jegou et al., "Aggregating local descriptors into a
compact image representation", CVPR 2010). pycolmap's `VisualIndex` does not return the result of a
query to Python.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_av1.matching.features.sift import NUM_DIMENSIONS, Features
from colmap_av1.util.arrays import Bools

_NUM_WORDS = 64
# Number of descriptors on which the vocabulary is trained.
_NUM_TRAINING = 20_000
_NUM_ITERATIONS = 10


def similar_images(
    features: Sequence[Features], allowed: Bools, num_nearest: int, *, seed: int = 0
) -> NDArray[np.int32]:
    """Pair each image with the images most similar to it.

    Args:
        features: features of each image.
        allowed: bool [n, n] which images may be paired; symmetric.
        num_nearest: largest number of images with which each is paired.
        seed: seed of the vocabulary.

    Returns:
        int32 [m, 2] indices of images, first < second, ascending.
    """
    vectors = _aggregate(features, seed)
    similarity = np.where(allowed, vectors @ vectors.T, -np.inf)
    order = np.argsort(-similarity, axis=1, kind="stable")[:, :num_nearest]
    pairs = {
        (min(i, j), max(i, j))
        for i, row in enumerate(order.tolist())
        for j in row
        if i != j and allowed[i, j]
    }
    return np.array(sorted(pairs), dtype=np.int32).reshape(-1, 2)


def _aggregate(features: Sequence[Features], seed: int) -> NDArray[np.float32]:
    """One unit vector for each image, [n, words * 128]; zeros if an image has no features."""
    from scipy.cluster.vq import kmeans2  # noqa: PLC0415 - slow to import

    vectors = np.zeros((len(features), _NUM_WORDS, NUM_DIMENSIONS), dtype=np.float32)
    rng = np.random.default_rng(seed)
    # Descriptors are chosen by their number through all images, whose concatenation would be large.
    first = np.cumsum([0, *(len(f.descriptors) for f in features)])
    chosen = rng.permutation(first[-1])[:_NUM_TRAINING]
    owner = np.searchsorted(first, chosen, side="right") - 1
    training = np.empty((len(chosen), NUM_DIMENSIONS), np.float32)
    for number, own in enumerate(features):
        is_own = owner == number
        training[is_own] = own.descriptors[chosen[is_own] - first[number]]
    if len(training) < _NUM_WORDS:
        return vectors.reshape(len(features), -1)
    words, _ = kmeans2(training, _NUM_WORDS, iter=_NUM_ITERATIONS, minit="points", seed=seed)
    half_length = 0.5 * (words * words).sum(axis=1)
    for index, image in enumerate(features):
        word = (image.descriptors @ words.T - half_length).argmax(axis=1)
        np.add.at(vectors[index], word, image.descriptors - words[word])
    vectors /= np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), 1e-9)
    flat = vectors.reshape(len(features), -1)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9))
