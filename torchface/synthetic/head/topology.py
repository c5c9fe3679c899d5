"""The head's quads: one half laid out on a grid round the head, with ring systems round eye, mouth, ear and nostril.

A ring system replaces a rectangular block of the grid by loops that run round the block, each as long as its border;
the inmost loop is closed by a small grid. So every face is a quad and every opening has edge loops round it.
"""

from dataclasses import dataclass, field
from functools import lru_cache

import torch
from torch import Tensor

ROWS, COLUMNS = 43, 34
CAP_SIDE = 10  # the crown's small grid: CAP_SIDE edges front, COLUMNS - 2 CAP_SIDE edges along the side, CAP_SIDE back
EYEBALL_SEGMENTS = 24


@dataclass(frozen=True)
class Block:
    """Grid rows and columns (first, last) that a ring system replaces; ``rings`` loops inside the block's border."""

    top: int
    bottom: int
    left: int
    right: int
    rings: int

    @property
    def height(self) -> int:
        return self.bottom - self.top

    @property
    def width(self) -> int:
        return self.right - self.left


EYE = Block(8, 14, 6, 16, 15)
MOUTH = Block(22, 28, 0, 10, 16)
NOSTRIL = Block(19, 21, 1, 5, 5)
EAR = Block(9, 21, 21, 25, 10)
EYE_RIM, MOUTH_BORDER, MOUTH_CONTACT, NOSTRIL_RIM, EAR_RIM = 8, 5, 9, 2, 4
"""Rings that mean something: lid edge, border of the red of the lips, where lips touch, nostril and ear edge."""


@dataclass(frozen=True, eq=False)
class Topology:
    """Which vertices form what; ids are into the half head (x ≥ 0), then the whole."""

    grid: Tensor  # the head's grid, (ROWS+1, COLUMNS+1), -1 inside blocks
    crown: Tensor  # the crown's grid, (CAP_SIDE+1, COLUMNS-2*CAP_SIDE+1); its first row is the midline
    # Loops (rings+1, L) by name, from the block's border inwards; the mouth's run from midline to midline.
    rings: dict[str, Tensor]
    caps: dict[str, Tensor]  # grids (h+1, w+1) that close each inmost loop
    eyeball: Tensor  # the left eyeball's loops (K, EYEBALL_SEGMENTS), front to back, and its two closing grids
    half_count: int  # vertices of the half; midline marks those on x = 0
    midline: Tensor
    half_quads: Tensor  # (P,4)
    mirror: Tensor  # over the whole, (V,); count V
    count: int
    quads: Tensor  # of the whole, (2P,4)
    other_half: Tensor  # for each vertex of the half its twin in the whole, (half_count,)


@dataclass
class _Builder:
    count: int = 0
    quads: list[Tensor] = field(default_factory=list)

    def new(self, *shape: int) -> Tensor:
        ids = torch.arange(self.count, self.count + int(torch.tensor(shape).prod())).view(*shape)
        self.count += ids.numel()
        return ids

    def strip(self, outer: Tensor, inner: Tensor, closed: bool) -> None:
        """Quads between two loops that run clockwise seen from outside."""
        a, b = outer, inner
        after = lambda loop: loop.roll(-1, -1) if closed else loop[1:]  # noqa: E731
        before = lambda loop: loop if closed else loop[:-1]  # noqa: E731
        self.quads.append(torch.stack([before(a), before(b), after(b), after(a)], dim=-1))

    def sheet(self, grid: Tensor, holes: tuple[Block, ...] = ()) -> None:
        """Quads of a grid whose rows run down and columns to the viewer's right."""
        keep = torch.ones(grid.shape[0] - 1, grid.shape[1] - 1, dtype=torch.bool)
        for hole in holes:
            keep[hole.top : hole.bottom, hole.left : hole.right] = False
        corners = torch.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], dim=-1)
        self.quads.append(corners[keep])

    def close(self, loop: Tensor, height: int, width: int) -> Tensor:
        """A grid that fills a loop which started at its upper left corner."""
        grid = self.new(height + 1, width + 1)
        self.count -= grid.numel()
        grid.fill_(-1)
        rows, columns = perimeter(height, width)
        grid[rows, columns] = loop
        inner = grid == -1
        grid[inner] = self.new(int(inner.sum()))
        self.sheet(grid)
        return grid


def perimeter(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Row and column of a block's border, clockwise from its upper left corner, each (2*(height+width),)."""
    down, across = torch.arange(height), torch.arange(width)
    rows = [torch.zeros(width, dtype=torch.int64), down, torch.full((width,), height), height - down]
    columns = [across, torch.full((height,), width), width - across, torch.zeros(height, dtype=torch.int64)]
    return torch.cat(rows), torch.cat(columns)


def _border(grid: Tensor, block: Block) -> Tensor:
    rows, columns = perimeter(block.height, block.width)
    loop = grid[rows + block.top, columns + block.left]
    if block.left == 0:  # on the midline: from its upper to its lower end
        loop = loop[: 2 * block.width + block.height + 1]
    return loop


@lru_cache(maxsize=1)
def topology() -> Topology:
    """The one topology that every head has."""
    make = _Builder()
    blocks = {"eye": EYE, "mouth": MOUTH, "nostril": NOSTRIL, "ear": EAR}
    inside = torch.zeros(ROWS + 1, COLUMNS + 1, dtype=torch.bool)
    for block in blocks.values():
        first = 0 if block.left == 0 else block.left + 1
        inside[block.top + 1 : block.bottom, first : block.right] = True
    grid = torch.full((ROWS + 1, COLUMNS + 1), -1)
    grid[~inside] = make.new(int((~inside).sum()))
    make.sheet(grid, tuple(blocks.values()))
    rings, caps = {}, {}
    for name, block in blocks.items():
        loops = [_border(grid, block)]
        for _ in range(block.rings):
            loops.append(make.new(len(loops[0])))
            make.strip(loops[-2], loops[-1], closed=block.left > 0)
        rings[name] = torch.stack(loops)
        if block.left > 0:
            caps[name] = make.close(loops[-1], block.height, block.width)
    caps["mouth"] = _close_half(make, rings["mouth"][-1], MOUTH)
    crown = _crown(make, grid[0])
    eyeball = _eyeball(make)
    midline = torch.zeros(make.count, dtype=torch.bool)
    for on in (grid[:, 0], grid[:, -1], rings["mouth"][:, 0], rings["mouth"][:, -1], caps["mouth"][:, 0], crown[0]):
        midline[on[on >= 0]] = True
    caps.update({"eyeball_front": eyeball[1], "eyeball_back": eyeball[2]})
    return _whole(make, grid, crown, rings, caps, eyeball[0], midline)


def _close_half(make: _Builder, loop: Tensor, block: Block) -> Tensor:
    grid = torch.full((block.height + 1, block.width + 1), -1)
    rows, columns = perimeter(block.height, block.width)
    grid[rows[: len(loop)], columns[: len(loop)]] = loop
    grid[grid == -1] = make.new(int((grid == -1).sum()))
    make.sheet(grid)
    return grid


def _crown(make: _Builder, row: Tensor) -> Tensor:
    """A grid over the crown: the top row of the head is its front, outer and back side, its first row the midline."""
    grid = torch.full((CAP_SIDE + 1, COLUMNS - 2 * CAP_SIDE + 1), -1)
    grid[:, 0] = row[: CAP_SIDE + 1]
    grid[-1, :] = row[CAP_SIDE : COLUMNS - CAP_SIDE + 1]
    grid[:, -1] = row[COLUMNS - CAP_SIDE :].flip(0)
    grid[grid == -1] = make.new(int((grid == -1).sum()))
    # Seen from above with the front at the left, the midline on top: rows run away from it, columns to the back.
    corners = torch.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], dim=-1)
    make.quads.append(corners.reshape(-1, 4).flip(1))
    return grid


def _eyeball(make: _Builder) -> tuple[Tensor, Tensor, Tensor]:
    loops = make.new(11, EYEBALL_SEGMENTS)
    for outer, inner in zip(loops[1:], loops[:-1], strict=True):
        make.strip(outer, inner, closed=True)
    side = EYEBALL_SEGMENTS // 4
    front = make.close(loops[0], side, side)
    back_loop = torch.cat([loops[-1][side : side + 1], loops[-1][:side].flip(0), loops[-1][side + 1 :].flip(0)])
    back = make.close(back_loop, side, side)
    return loops, front, back


def _whole(
    make: _Builder,
    grid: Tensor,
    crown: Tensor,
    rings: dict[str, Tensor],
    caps: dict[str, Tensor],
    eyeball: Tensor,
    midline: Tensor,
) -> Topology:
    quads = torch.cat([q.reshape(-1, 4) for q in make.quads])
    half = make.count
    twin = torch.arange(half)
    twin[~midline] = half + torch.arange(int((~midline).sum()))
    count = half + int((~midline).sum())
    mirror = torch.arange(count)
    mirror[:half] = twin
    mirror[twin] = torch.arange(half)
    both = torch.cat([quads, twin[quads].flip(1)])
    return Topology(grid, crown, rings, caps, eyeball, half, midline, quads, mirror, count, both, twin)
