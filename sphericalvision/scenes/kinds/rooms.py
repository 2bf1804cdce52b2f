# SPDX-License-Identifier: Apache-2.0
"""Recipe for a furnished room around the rig: walls, door to a second room, window, furniture, lamps."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch

from sphericalvision.scenes.kinds.furniture import (
    AGAINST_WALLS,
    FREE_STANDING,
    footprint_radius,
    make_piece,
    moved,
    place,
)
from sphericalvision.scenes.kinds.labels import labelled
from sphericalvision.scenes.kinds.palette import DAYLIGHT, Palette, level
from sphericalvision.scenes.registry import register_scene
from sphericalvision.scenes.rendering.primitives import Part, pack
from sphericalvision.scenes.rendering.scene import Lamp, Scene

#: (from, to, upper, lower) along and down a wall, metres.
Opening = tuple[float, float, float, float]


@dataclass
class Room:
    """A room being furnished, from ``low`` to ``high`` (x, z); floor and ceiling are values of y."""

    palette: Palette
    low: tuple[float, float]
    high: tuple[float, float]
    floor: float
    ceiling: float
    clear: float
    parts: list[Part] = field(default_factory=list)
    lamps: list[Lamp] = field(default_factory=list)
    circles: list[tuple[float, float, float]] = field(default_factory=list)

    @classmethod
    def drawn(
        cls, palette: Palette, clear: float, sides: tuple[float, float], height: tuple[float, float]
    ) -> Room:
        """A room around the rig: its sides so far away, so high, each within bounds; its floor where people stand."""
        left, back, right, front = (palette.log_uniform(*sides) for _ in range(4))
        high = palette.uniform(*height)
        floor = palette.uniform(0.75, min(1.7, high - 0.8))
        return cls(palette, (-left, -back), (right, front), floor, floor - high, clear)

    def add(self, parts: list[Part]) -> bool:
        """Keep the parts unless one of them comes nearer to the rig than ``clear``."""
        if pack(parts).distance_from(torch.zeros(3)).min() < self.clear:
            return False
        self.parts += parts
        return True

    def stand(self, parts: list[Part], x: float, z: float, yaw: float) -> bool:
        """Stand furniture on the floor if there is room for it."""
        radius = footprint_radius(parts)
        if any(math.hypot(x - cx, z - cz) < 0.8 * (radius + other) for cx, cz, other in self.circles):
            return False
        reach = self.floor - self.ceiling
        placed = [part if part.half[1] < 2.9 else _from_floor_to_ceiling(part, reach) for part in parts]
        if self.add(place(placed, x, self.floor, z, yaw)):
            self.circles.append((x, z, radius))
            return True
        return False

    def sides(self) -> list[tuple[float, float, float, float, float]]:
        """The four walls: yaw, x and z of the wall's frame, and the wall's extent along its first axis."""
        (x0, z0), (x1, z1) = self.low, self.high
        return [
            (0.0, 0.0, z1, x0, x1),
            (math.pi / 2, x1, 0.0, -z1, -z0),
            (math.pi, 0.0, z0, -x1, -x0),
            (-math.pi / 2, x0, 0.0, z0, z1),
        ]

    def scene(self, ambient: torch.Tensor, background: torch.Tensor | None = None) -> Scene:
        """The scene of the room's parts and lamps; see ``Palette.scene``."""
        return self.palette.scene(self.parts, self.lamps, ambient, background)


def _from_floor_to_ceiling(part: Part, height: float) -> Part:
    (x, _, z), (wide, _, deep) = part.center, part.half
    return replace(part, center=(x, -height / 2, z), half=(wide, height / 2, deep))


@register_scene("room")
def random_room(generator: torch.Generator, clear_radius: float = 0.6) -> Scene:
    """A furnished room with the rig at its origin, y down; not yet exposed (see `make_scene`)."""
    palette = Palette(generator)
    sides = [palette.log_uniform(1.2, 6.0) for _ in range(4)]
    height = palette.uniform(2.3, 3.4) if palette.chance(0.8) else palette.uniform(3.4, 5.0)
    floor = palette.uniform(0.75, min(1.7, height - 0.8))
    room = Room(palette, (-sides[0], -sides[1]), (sides[2], sides[3]), floor, floor - height, clear_radius)
    order = torch.randperm(4, generator=generator).tolist()
    openings: dict[int, Opening] = {}
    if palette.chance(0.75):
        width, top = palette.uniform(0.8, 1.6), palette.uniform(1.9, 2.2)
        openings[order[0]] = random_opening(room, order[0], width, 0.0, top)
    if palette.chance(0.5):
        bottom = palette.uniform(0.4, 1.0)
        width, top = palette.uniform(0.8, 2.0), palette.uniform(1.6, 2.1)
        openings[order[1]] = random_opening(room, order[1], width, bottom, top)
    build_shell(room, openings)
    hang_lamps(room, palette.integer(1, 2))
    for side, opening in openings.items():
        (add_door if side == order[0] else add_window)(room, side, opening)
    fill(room, palette.integer(8, 18))
    strength, tint = palette.uniform(0.06, 0.14), [1.0, palette.uniform(0.9, 1.0), palette.uniform(0.8, 1.1)]
    return room.scene(strength * torch.tensor(tint), DAYLIGHT * palette.uniform(0.5, 1.2))


def random_opening(room: Room, side: int, width: float, bottom: float, top: float) -> Opening:
    """An opening somewhere in a wall, ``bottom`` and ``top`` metres above the floor."""
    _, _, _, start, end = room.sides()[side]
    width = min(width, 0.8 * (end - start))
    first = room.palette.uniform(start + 0.1, end - width - 0.1)
    return first, first + width, max(room.floor - top, room.ceiling + 0.1), room.floor - bottom


def wall_piece(
    material: int, yaw: float, x: float, z: float, extent: Opening, casts: bool, lift: float = 0.0
) -> list[Part]:
    """A piece of a wall in the wall's own frame, ``lift`` metres in front of it; nothing where it has no
    area."""
    first, last, upper, lower = extent
    if last - first < 1e-3 or lower - upper < 1e-3:
        return []
    along, down = (first + last) / 2, (upper + lower) / 2
    half = ((last - first) / 2, (lower - upper) / 2, 1.0)
    flat = Part("rectangle", (along, 0.0, -lift), half, material, casts_shadow=casts, uv_origin=(along, down))
    return place([flat], x, down, z, yaw)


def build_shell(room: Room, openings: dict[int, Opening], skip: int | None = None) -> None:
    """Floor, ceiling and walls of any look, with holes where the openings are."""
    palette = room.palette
    glossy = palette.uniform(0.08, 0.3) if palette.chance(0.35) else 0.0
    grounds = ("wood", "wood", "tiles", "checks", "noise", "weave", "marble", "mosaic", "bricks")
    ground = palette.patterned(grounds, palette.uniform(0.8, 2.5), palette.uniform(0.6, 1.0), mirror=glossy)
    roof = palette.paint() if palette.chance(0.7) else palette.any_surface(2.0)
    wall = palette.paint() if palette.chance(0.4) else palette.any_surface(2.5)
    walls = {
        side: wall if palette.chance(0.6) else palette.any_surface(2.5) for side in range(4) if side != skip
    }
    # Only with an opening can a lamp stand on the other side of these.
    add_shell(room, ground, roof, walls, openings, casts=bool(openings))


def add_shell(
    room: Room, ground: int, roof: int, walls: dict[int, int], openings: dict[int, Opening], casts: bool
) -> None:
    """Floor, ceiling and walls of given materials, with holes where the openings are."""
    (x0, z0), (x1, z1) = room.low, room.high
    for y, material, name in ((room.floor, ground, "floor"), (room.ceiling, roof, "ceiling")):
        plane = level((x0 + x1) / 2, y, (z0 + z1) / 2, (x1 - x0) / 2, (z1 - z0) / 2, material, casts)
        room.parts += labelled([plane], name)
    for side, material in walls.items():
        yaw, x, z, start, end = room.sides()[side]
        pieces = [(start, end, room.ceiling, room.floor)]
        if side in openings:
            first, last, upper, lower = openings[side]
            pieces = [
                (start, first, room.ceiling, room.floor),
                (last, end, room.ceiling, room.floor),
                (first, last, room.ceiling, upper),
                (first, last, lower, room.floor),
            ]
        for piece in pieces:
            room.parts += labelled(wall_piece(material, yaw, x, z, piece, casts), "wall")


def add_frame(room: Room, side: int, opening: Opening, material: int, name: str) -> None:
    """A frame around an opening."""
    yaw, x, z, _, _ = room.sides()[side]
    first, last, upper, lower = opening
    down, half = (upper + lower) / 2, (lower - upper) / 2
    bars = [Part("box", (edge, down, 0.0), (0.04, half, 0.06), material) for edge in (first, last)]
    lintel = ((last - first) / 2 + 0.04, 0.04, 0.06)
    bars.append(Part("box", ((first + last) / 2, upper, 0.0), lintel, material))
    room.add(labelled(place(bars, x, 0.0, z, yaw), name))


def add_door(room: Room, side: int, opening: Opening) -> None:
    """A frame, an open leaf, and a furnished second room behind."""
    palette = room.palette
    yaw, x, z, _, _ = room.sides()[side]
    first, last, upper, lower = opening
    material = palette.wood() if palette.chance(0.5) else palette.paint()
    add_frame(room, side, opening, material, "door")
    half = ((last - first) / 2 - 0.02, (lower - upper) / 2 - 0.02, 0.02)
    leaf = [Part("box", (half[0], 0.0, 0.0), half, palette.any_surface(1.5))]
    swung = place(leaf, first + 0.04, (upper + lower) / 2, 0.0, -palette.uniform(0.7, 2.0))
    room.add(labelled(place(swung, x, 0.0, z, yaw), "door"))
    # The second room in the wall's frame: it starts at z = 0 there, and shares its wall with the first.
    left, right, depth = palette.uniform(0.5, 2.0), palette.uniform(0.5, 2.0), palette.uniform(1.8, 4.5)
    ceiling = min(upper - 0.1, room.floor - palette.uniform(2.3, 2.8))
    other = Room(palette, (first - left, 0.0), (last + right, depth), room.floor, ceiling, -1.0)
    build_shell(other, {}, skip=2)
    other.circles.append(((first + last) / 2, 0.0, 0.6))
    hang_lamps(other, 1)
    furnish(other, palette.integer(2, 4))
    room.parts += place(other.parts, x, 0.0, z, yaw)
    room.lamps += [lamp._replace(position=moved(lamp.position, x, 0.0, z, yaw)) for lamp in other.lamps]
    in_front = moved(((first + last) / 2, 0.0, 0.0), x, 0.0, z, yaw)
    room.circles.append((in_front[0], in_front[2], 0.5))


def add_window(room: Room, side: int, opening: Opening) -> None:
    """A frame with a cross of bars, and mostly a bright view behind; else open sky."""
    palette = room.palette
    yaw, x, z, _, _ = room.sides()[side]
    first, last, upper, lower = opening
    material = palette.paint()
    add_frame(room, side, opening, material, "window")
    along, down = (first + last) / 2, (upper + lower) / 2
    bars = [
        Part("box", (along, down, 0.0), (0.02, (lower - upper) / 2, 0.02), material),
        Part("box", (along, down, 0.0), ((last - first) / 2, 0.02, 0.02), material),
    ]
    room.add(labelled(place(bars, x, 0.0, z, yaw), "window"))
    if palette.chance(0.6):
        distance = palette.uniform(3.0, 15.0)
        view = palette.photograph(palette.uniform(0.8, 1.6) * distance, emission=palette.uniform(0.3, 0.7))
        wide = (along - 6 * distance, along + 6 * distance, down - 6 * distance, down + 6 * distance)
        room.parts += labelled(wall_piece(view, yaw, x, z, wide, casts=False, lift=-distance), "window")


def hang_lamps(room: Room, count: int) -> None:
    """Lamps under the ceiling, each with a bulb and a cable."""
    palette = room.palette
    (x0, z0), (x1, z1) = room.low, room.high
    for _ in range(count):
        x = palette.uniform(0.8 * x0 + 0.2 * x1, 0.2 * x0 + 0.8 * x1)
        z = palette.uniform(0.8 * z0 + 0.2 * z1, 0.2 * z0 + 0.8 * z1)
        drop, radius = palette.uniform(0.15, 0.6), palette.uniform(0.05, 0.13)
        tint = (1.0, palette.uniform(0.8, 1.0), palette.uniform(0.6, 1.0))
        size = math.sqrt((x1 - x0) * (z1 - z0))
        power = 0.5 * size * palette.uniform(0.6, 1.4)
        bulb, cable = palette.glowing(tint, 1.5), palette.metal()
        y = room.ceiling + drop
        hung, thin = (x, room.ceiling + drop / 2, z), (0.01, drop / 2, 0.01)
        fitting = [
            Part("ellipsoid", (x, y, z), (radius, radius, radius), bulb, casts_shadow=False),
            Part("cylinder", hung, thin, cable, casts_shadow=False),
        ]
        # A lamp right above the rig stays, without its bulb.
        room.add(labelled(fitting, "lamp"))
        color = (power * tint[0], power * tint[1], power * tint[2])
        room.lamps.append(Lamp((x, y, z), color, reach=palette.uniform(1.0, 2.0)))


def fill(room: Room, count: int, rug: bool = True) -> None:
    """Pieces of furniture, pictures and perhaps a rug, and small things at the height of the rig."""
    furnish(room, count)
    decorate(room, rug)
    _hang_small_things(room)


def furnish(room: Room, count: int) -> None:
    """Furniture along the walls and in the middle."""
    palette = room.palette
    (x0, z0), (x1, z1) = room.low, room.high
    for _ in range(count):
        if palette.chance(0.5):
            pieces = make_piece(palette.choose(AGAINST_WALLS), palette)
            yaw, x, z, start, end = palette.choose(room.sides())
            depth = max(part.half[2] - part.center[2] for part in pieces) + 0.03
            width = max(abs(part.center[0]) + part.half[0] for part in pieces)
            if end - start < 2 * width:
                continue
            along = palette.uniform(start + width, end - width)
            # Walls look outwards in their frame; furniture looks into the room.
            spot = moved((along, 0.0, -depth), x, 0.0, z, yaw)
            room.stand(pieces, spot[0], spot[2], yaw + math.pi)
        else:
            pieces = make_piece(palette.choose(FREE_STANDING), palette)
            edge = min(footprint_radius(pieces), 0.45 * min(x1 - x0, z1 - z0))
            spot_x, spot_z = palette.uniform(x0 + edge, x1 - edge), palette.uniform(z0 + edge, z1 - edge)
            room.stand(pieces, spot_x, spot_z, palette.uniform(0, 2 * math.pi))


def decorate(room: Room, rug: bool = True) -> None:
    """Pictures on the walls, and perhaps a rug where one is welcome."""
    palette = room.palette
    for yaw, x, z, start, end in room.sides():
        for _ in range(palette.integer(0, 2)):
            wide, high = palette.uniform(0.2, 0.6), palette.uniform(0.2, 0.5)
            if end - start < 2 * wide + 0.4:
                continue
            along = palette.uniform(start + wide, end - wide)
            down = palette.uniform(room.ceiling + high + 0.1, room.floor - high - 0.6)
            picture = palette.photograph((2 * wide, 2 * high))
            frame = palette.metal()
            board = [
                Part("box", (along, down, 0.0), (wide + 0.03, high + 0.03, 0.015), frame, casts_shadow=False),
                Part("rectangle", (along, down, -0.018), (wide, high, 1.0), picture, casts_shadow=False),
            ]
            spot = labelled(place(board, x, 0.0, z, yaw), "picture")
            if not any(_over(spot[0], other) for other in room.parts if other.shape == "box"):
                room.add(spot)
    if rug and palette.chance(0.5):
        (x0, z0), (x1, z1) = room.low, room.high
        half = (palette.uniform(0.2, 0.4) * (x1 - x0), 0.004, palette.uniform(0.2, 0.4) * (z1 - z0))
        center = ((x0 + x1) / 2, room.floor - 0.004, (z0 + z1) / 2)
        rug_on_floor = Part("box", center, half, palette.any_surface(1.5), casts_shadow=False)
        room.add(labelled([rug_on_floor], "floor"))


def _over(part: Part, other: Part) -> bool:
    """Whether two parts' centres are so near that their bounding balls meet."""
    return math.dist(part.center, other.center) < math.hypot(*part.half) + 0.6 * math.hypot(*other.half)


def _hang_small_things(room: Room) -> None:
    """Thin and small things at the height of the rig, so that near depths occur too."""
    palette = room.palette
    for _ in range(palette.integer(1, 4)):
        angle, away = palette.uniform(0, 2 * math.pi), palette.log_uniform(room.clear + 0.05, 2.5)
        x, z = away * math.sin(angle), away * math.cos(angle)
        if not (room.low[0] < x < room.high[0] and room.low[1] < z < room.high[1]):
            continue
        y = palette.uniform(max(room.ceiling + 0.4, -0.8), min(room.floor - 0.3, 0.5))
        half = (palette.uniform(0.03, 0.2), palette.uniform(0.03, 0.2), palette.uniform(0.03, 0.2))
        cable = (y - half[1] - room.ceiling) / 2
        shape, material = palette.choose(("ellipsoid", "box", "cylinder")), palette.any_surface(0.4)
        thing = [
            Part(shape, (x, y, z), half, material, yaw=angle),
            Part("cylinder", (x, room.ceiling + cable, z), (0.008, cable, 0.008), palette.metal()),
        ]
        room.add(thing)
