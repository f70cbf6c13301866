"""The ends of a walked surface by the definition: where the walk cannot go on without first going
back by so much.
"""

import numpy as np

from liex_lab.scene._blob_kernels import BLOCK


def ends_by_hand(
    order: np.ndarray, hops: np.ndarray, blocks: np.ndarray, focal: float, least_mm: float
) -> set[tuple[int, int]]:
    """Blocks (row, column) from which every way to a block later in the order goes back by at least
    `least_mm`.

    order (n, 2): blocks in the order of their distance; hops (n,) their distances.
    """
    rank = {(int(r), int(c)): k for k, (r, c) in enumerate(order)}
    found = set()
    for k, (r, c) in enumerate(order):
        pass_ = _highest_pass(rank, hops, k)
        sticks_out = (
            (hops[k] - pass_) * BLOCK * blocks[r, c] / focal if pass_ is not None else np.inf
        )
        if sticks_out >= least_mm:
            found.add((int(r), int(c)))
    return found


def _highest_pass(rank: dict[tuple[int, int], int], hops: np.ndarray, start: int) -> int | None:
    """On the way from block `start` to any block later in the order: the distance of the lowest
    block that has to be crossed, on the best way; None where there is no such block.
    """
    blocks = list(rank)
    for lowest in range(
        start, -1, -1
    ):  # only blocks at least this late in the order may be crossed
        reached, queue = {blocks[start]}, [blocks[start]]
        while queue:
            r, c = queue.pop()
            for a in (r - 1, r, r + 1):
                for b in (c - 1, c, c + 1):
                    if (a, b) in rank and (a, b) not in reached and rank[a, b] >= lowest:
                        reached.add((a, b))
                        queue.append((a, b))
        if any(rank[block] > start for block in reached):
            return int(hops[lowest])
    return None
