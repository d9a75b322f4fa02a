"""The mazes: nine rooms each, in a square, and the passages between them.

All have a hub in the middle with a passage to each side. They differ in the ways to the corners: in the red
maze these lead through the upper and the lower room, in the blue maze through the left and the right room.
The green maze has the upper corners of the blue one and the lower corners of the red one. A room therefore
has the same place in every maze, but the way to it begins in another direction.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

Place: TypeAlias = tuple[float, float]
Cell: TypeAlias = tuple[int, int]
"""Row, from the top, and column, from the left."""

SIZE = 5
"""Cells along a side, each 1 m wide: rooms have even rows and columns, passages connect them."""

ROOMS: dict[str, Cell] = {
    "upper_left": (0, 0),
    "upper": (0, 2),
    "upper_right": (0, 4),
    "left": (2, 0),
    "middle": (2, 2),
    "right": (2, 4),
    "lower_left": (4, 0),
    "lower": (4, 2),
    "lower_right": (4, 4),
}

DIRECTIONS: tuple[Cell, ...] = ((0, 1), (0, -1), (-1, 0), (1, 0))
"""Steps of one cell to the right, to the left, up and down."""


def centre(cell: Cell) -> Place:
    """Return the centre (x, y) of a cell in metres."""
    return cell[1] - SIZE // 2, SIZE // 2 - cell[0]


@dataclass(frozen=True)
class Maze:
    """The free cells of a maze and the ways through it."""

    colour: str
    """Colour of the walls, also the name of the maze."""
    drawing: tuple[str, ...]
    """One character per cell, row by row from the top: "o" is a room, "-" and "|" a passage, " " a wall."""

    @cached_property
    def free(self) -> tuple[Cell, ...]:
        """Cells without a wall, row by row."""
        return tuple(
            (row, column)
            for row, line in enumerate(self.drawing)
            for column, character in enumerate(line)
            if character != " "
        )

    @cached_property
    def _nearest(self) -> dict[Cell, Cell]:
        """Nearest free cell to each cell: the cell itself, unless it is a wall."""
        cells = [(row, column) for row in range(SIZE) for column in range(SIZE)]
        return {cell: min(self.free, key=lambda free: math.dist(free, cell)) for cell in cells}

    @cached_property
    def _ways(self) -> dict[str, dict[Cell, tuple[Cell, int]]]:
        """For each room and cell: the next cell on the shortest way to the room, and the cells left to go."""
        return {room: self._ways_to(goal) for room, goal in ROOMS.items()}

    def _ways_to(self, goal: Cell) -> dict[Cell, tuple[Cell, int]]:
        ways, queue = {goal: (goal, 0)}, deque([goal])
        while queue:
            cell = queue.popleft()
            for row, column in DIRECTIONS:
                neighbour = (cell[0] + row, cell[1] + column)
                if neighbour in self.free and neighbour not in ways:
                    ways[neighbour] = (cell, ways[cell][1] + 1)
                    queue.append(neighbour)
        return ways

    @cached_property
    def _reach(self) -> dict[Cell, tuple[int, ...]]:
        """Number of free cells straight ahead of each cell, in each of the `DIRECTIONS`."""
        return {
            cell: tuple(self._straight(cell, direction) for direction in DIRECTIONS) for cell in self.free
        }

    def _straight(self, cell: Cell, direction: Cell) -> int:
        steps = 0
        while (cell := (cell[0] + direction[0], cell[1] + direction[1])) in self.free:
            steps += 1
        return steps

    def cell(self, place: Place) -> Cell:
        """Return the cell of a place, or the nearest free cell if that is a wall."""
        column, row = round(place[0]) + SIZE // 2, SIZE // 2 - round(place[1])
        return self._nearest[min(max(row, 0), SIZE - 1), min(max(column, 0), SIZE - 1)]

    def steps(self, cell: Cell, room: str) -> int:
        """Return the length of the shortest way from a free cell to a room, in cells."""
        return self._ways[room][cell][1]

    def way(self, place: Place, room: str) -> tuple[Place, float]:
        """Return the next point (x, y) on the shortest way to a room, and the distance to the room's centre.

        Points are centres of cells, distances are in metres; in the room, the point is the room's own centre.
        """
        ways = self._ways[room]
        following = ways[self.cell(place)][0]
        point = centre(following)
        return point, math.dist(place, point) + ways[following][1]

    def room_ahead(self, place: Place) -> tuple[float, float, float, float]:
        """Return the distances in metres to the wall on the right, on the left, above and below."""
        cell = self.cell(place)
        right, left, above, below = self._reach[cell]
        x, y = centre(cell)
        dx, dy = place[0] - x, place[1] - y
        return right + 0.5 - dx, left + 0.5 + dx, above + 0.5 - dy, below + 0.5 + dy


MAZES: dict[str, Maze] = {
    maze.colour: maze
    for maze in (
        Maze("red", ("o-o-o", "  |  ", "o-o-o", "  |  ", "o-o-o")),
        Maze("blue", ("o o o", "| | |", "o-o-o", "| | |", "o o o")),
        Maze("green", ("o o o", "| | |", "o-o-o", "  |  ", "o-o-o")),
    )
}
"""Mazes by colour, in the order of the state's `COLOUR`."""
