"""Anchors lie where cells have their middles; boxes that were planted come back, and those of one face become one."""

import numpy as np
import torch

from torchface.landmarks.images.face_landmarker.short_range_boxes import SIDE, anchor_middles, decoded, merged


def test_anchors_by_loops() -> None:
    wanted = [
        ((column + 0.5) / cells, (row + 0.5) / cells)
        for cells, each in ((16, 2), (8, 6))
        for row in range(cells)
        for column in range(cells)
        for _ in range(each)
    ]
    np.testing.assert_allclose(anchor_middles(), wanted, rtol=1e-6)


def test_planted_boxes_come_back() -> None:
    anchors, rng = anchor_middles(), np.random.default_rng(0)
    regressors, logits = np.zeros((896, 16), np.float32), np.full(896, -80.0, np.float32)
    planted = {}
    for row in rng.choice(896, 5, replace=False):
        middle, size, points = rng.random(2), 0.1 + rng.random(2), rng.random((6, 2))
        regressors[row] = SIDE * np.concatenate([middle - anchors[row], size, (points - anchors[row]).ravel()])
        logits[row] = rng.uniform(0.2, 3)
        planted[float(logits[row])] = (np.concatenate([middle - size / 2, size]), points)
    logits[rng.choice(896)] = -1e9
    boxes, points, scores = decoded(regressors, logits, 0.5)
    order = sorted(planted, reverse=True)
    np.testing.assert_allclose(scores, [1 / (1 + np.exp(-value)) for value in order], rtol=1e-5)
    np.testing.assert_allclose(boxes, [planted[value][0] for value in order], atol=1e-5)
    np.testing.assert_allclose(points, [planted[value][1] for value in order], atol=1e-5)


def by_hand(boxes: np.ndarray, points: np.ndarray, scores: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Weighted suppression, box by box."""

    def shared(a: np.ndarray, b: np.ndarray) -> float:
        width = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
        height = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
        both = max(width, 0) * max(height, 0)
        return both / (a[2] * a[3] + b[2] * b[3] - both)

    left, faces = list(range(len(boxes))), []
    while left:
        own = [row for row in left if shared(boxes[left[0]], boxes[row]) > 0.3]
        weight = scores[own] / scores[own].sum()
        faces.append((weight @ boxes[own], np.tensordot(weight, points[own], 1), scores[left[0]]))
        left = [row for row in left if row not in own]
    return faces


def test_boxes_of_one_face_are_merged() -> None:
    rng = np.random.default_rng(1)
    middles = rng.random((4, 2))[rng.integers(0, 4, 40)] + 0.03 * rng.standard_normal((40, 2))
    size = 0.2 + 0.03 * rng.standard_normal((40, 2))
    boxes, points = np.concatenate([middles - size / 2, size], 1), rng.random((40, 6, 2))
    scores = np.sort(rng.uniform(0.5, 1, 40))[::-1].copy()
    found = merged(*(torch.from_numpy(part) for part in (boxes, points, scores)))
    wanted = by_hand(boxes, points, scores)
    assert 2 <= len(wanted) < 10
    for part, numbers in enumerate(found):
        np.testing.assert_allclose(numbers, [face[part] for face in wanted], rtol=1e-9)


def test_no_box_is_no_face() -> None:
    boxes, points, scores = merged(*decoded(np.zeros((896, 16), np.float32), np.full(896, -9.0, np.float32), 0.5))
    assert (boxes.shape, points.shape, scores.shape) == ((0, 4), (0, 6, 2), (0,))
