"""The pieces in which the zero level crosses a cell, by the signs of its corners.

Corners of a cell are numbered 4 dx + 2 dy + dz; its edges 4 axis + 2 a + b, with a and b the offsets along the two
other axes in ascending order.
"""

import numpy as np


def _edge(first: int, second: int) -> int:
    """Return the number of the edge between two neighbouring corners."""
    axis = {4: 0, 2: 1, 1: 2}[first ^ second]
    offsets = [(first >> 2) & 1, (first >> 1) & 1, first & 1]
    del offsets[axis]
    return 4 * axis + 2 * offsets[0] + offsets[1]


def _pieces() -> np.ndarray:
    """Return (256, 12) int8: which piece of surface crosses each edge of a cell, by its corners' signs; -1 = none.

    Bit c of the case is set where corner c is inside. Two pieces meet in a face whose diagonals differ; there the
    inside corners are joined, which keeps thin parts whole, and the choice rests on the face alone: neighbours agree.
    """
    faces = []
    for axis in range(3):
        one, two = 4 >> ((axis + 1) % 3), 4 >> ((axis + 2) % 3)
        for level in (0, 4 >> axis):
            faces.append([level, level | one, level | one | two, level | two])
    table = np.full((256, 12), -1, dtype=np.int8)
    for case in range(256):
        links: dict[int, list[int]] = {}
        for face in faces:
            inside = [bool(case >> corner & 1) for corner in face]
            edges = [_edge(face[k], face[(k + 1) % 4]) for k in range(4)]
            crossed = [edges[k] for k in range(4) if inside[k] != inside[(k + 1) % 4]]
            if len(crossed) == 4:
                # Join the inside: cut off the outside corners, each with the two edges that meet there.
                pairs = [(edges[k - 1], edges[k]) for k in range(4) if not inside[k]]
            else:
                pairs = [(crossed[0], crossed[1])] if crossed else []
            for a, b in pairs:
                links.setdefault(a, []).append(b)
                links.setdefault(b, []).append(a)
        piece = 0
        for start in sorted(links):
            if table[case, start] >= 0:
                continue
            waiting = [start]
            while waiting:
                edge = waiting.pop()
                if table[case, edge] < 0:
                    table[case, edge] = piece
                    waiting.extend(links[edge])
            piece += 1
    return table


PIECES = _pieces()
